# make demo   pictures of the embedded scene in out/demo/
# make test   the tests
# Both make their own virtual environment in .venv, see to a working libLLVM, and may be run again and again.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: demo test lint llvm venv clean help
help:
	@sed -n '1,3p' Makefile

# A new pyproject.toml installs anew; otherwise the environment is left as it is.
$(STAMP): pyproject.toml tools/install.sh
	@sh tools/install.sh "$(PYTHON)" "$(VENV)"
	@touch $(STAMP)

venv: $(STAMP)

llvm:
	@sh tools/llvm.sh

demo: llvm $(STAMP)
	$(BIN)/seasonscapes demo -o out/demo

test: llvm $(STAMP)
	$(BIN)/python -m pytest -q

lint: $(STAMP)
	$(BIN)/ruff check . && $(BIN)/ruff format --check .

clean:
	rm -rf $(VENV) out
