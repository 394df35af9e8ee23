# make demo   pictures of the bundled scene in out/demo/
# make test   the tests
# make check  the quick part of both: style, layers, and the tests that take milliseconds
# make lint   style, types and layers: ruff, pyright, import-linter
# Each makes the virtual environment .venv if it is missing, finds or installs libLLVM where it is needed, and can be
# repeated at will. PYTHON=python3.12 chooses the interpreter, CONSTRAINTS=constraints.txt installs the tested versions.

PYTHON ?= python3
CONSTRAINTS ?=
VENV := .venv
BIN := $(VENV)/bin
BASE := $(VENV)/.installed
DEV := $(VENV)/.installed-dev

.PHONY: demo test check lint venv dev llvm clean help
help:
	@sed -n '1,6p' Makefile

# A new pyproject.toml installs anew; otherwise the environment is left as it is.
$(BASE): pyproject.toml tools/install.sh
	@sh tools/install.sh "$(PYTHON)" "$(VENV)" "" "$(CONSTRAINTS)"
	@touch $(BASE)

# The developer's tools, with all extras: PyTorch, diffusers and Dask are tested too.
$(DEV): pyproject.toml tools/install.sh
	@sh tools/install.sh "$(PYTHON)" "$(VENV)" "[dev]" "$(CONSTRAINTS)"
	@touch $(BASE) $(DEV)

venv: $(BASE)

dev: $(DEV)

llvm:
	@sh tools/llvm.sh

demo: llvm $(BASE)
	$(BIN)/seasonscapes demo -o out/demo

test: llvm $(DEV)
	$(BIN)/python -m pytest -q -n 2

check: $(DEV)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/python -m pytest -q -n 2 -m fast

lint: $(DEV)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports

clean:
	rm -rf $(VENV) out
