# make demo   pictures of the bundled scene in out/demo/; `make gallery` adds a night and a film
# make test   the tests
# make check  the quick part of both: style, layers, and the tests that take milliseconds
# make lint   style, types and layers: ruff, pyright, import-linter
# make docs   the site in docs/_build/html; a warning is an error. docs-notebooks executes its notebooks first
# make sky-tables the atmosphere tables of the bundled sky models, after a change of their physics
# make massif the heights of the bundled scenes, after a change of their generator
# make tables the tables of README and site from benchmarks/results; `make results` measures those anew, in hours
# Each makes the virtual environment .venv if it is missing, finds or installs libLLVM where it is needed, and can be
# repeated at will. PYTHON=python3.12 chooses the interpreter, CONSTRAINTS=constraints.txt installs the tested versions.

PYTHON ?= python3
CONSTRAINTS ?=
VENV := .venv
BIN := $(VENV)/bin
BASE := $(VENV)/.installed
DEV := $(VENV)/.installed-dev
# Tests, site and commands start many processes: each would compile the program anew where none of them may keep it.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo gallery test check docs docs-notebooks sky-tables massif tables results lint venv dev llvm clean help
help:
	@sed -n '1,8p' Makefile

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

gallery: llvm $(BASE)
	$(BIN)/seasonscapes demo --gallery -o out/demo

# A file's tests share what its fixtures make: each file is of one worker, in the order of `tests/conftest.py`.
test: llvm $(DEV)
	$(BIN)/python -m pytest -q -n 2 --dist loadfile --no-loadscope-reorder --durations=25

# The page of a place in the site needs the renderer.
docs: llvm $(DEV)
	$(BIN)/sphinx-build -q -W --keep-going docs docs/_build/html

docs-notebooks: $(DEV)
	$(BIN)/python docs/run_notebooks.py

sky-tables: $(BASE)
	$(BIN)/python -m seasonscapes.sky.shipped_tables

massif: $(BASE)
	$(BIN)/python -m seasonscapes.terrain.shipped_massif

tables: $(DEV)
	$(BIN)/python benchmarks/tables.py

# One after the other: they measure times.
results: $(DEV)
	$(BIN)/python benchmarks/terrain.py --quick --json benchmarks/results/terrain-quick.json
	$(BIN)/python benchmarks/surface.py --quick --json benchmarks/results/surface-quick.json
	$(BIN)/python benchmarks/render.py --quick --json benchmarks/results/render-quick.json
	$(BIN)/python benchmarks/sky.py --json benchmarks/results/sky.json
	$(BIN)/python benchmarks/sky_night.py --json benchmarks/results/sky_night.json
	$(BIN)/python benchmarks/light_series.py --quick --json benchmarks/results/light_series-quick.json
	$(BIN)/python benchmarks/realbench.py --quick --json benchmarks/results/realbench-quick.json
	$(BIN)/python benchmarks/realbench_losses.py --quick --json benchmarks/results/realbench_losses-quick.json
	$(BIN)/python benchmarks/relight.py --json benchmarks/results/relight.json
	$(BIN)/python benchmarks/texturing.py --quick --json benchmarks/results/texturing-quick.json
	$(BIN)/python benchmarks/albedo.py --quick --json benchmarks/results/albedo-quick.json
	$(BIN)/python benchmarks/subgrid_normals.py --json benchmarks/results/subgrid_normals.json
	$(BIN)/python benchmarks/delight.py --quick --json benchmarks/results/delight-quick.json
	$(BIN)/python benchmarks/gaussians.py --quick --json benchmarks/results/gaussians-quick.json
	$(BIN)/python benchmarks/alpinebench.py --quick --json benchmarks/results/alpinebench-quick.json
	$(BIN)/python benchmarks/alpinebench_contributions.py --json benchmarks/results/alpinebench-contributions.json
	$(BIN)/python benchmarks/viewer.py --quick --json benchmarks/results/viewer-quick.json
	$(BIN)/python benchmarks/detail.py --quick --json benchmarks/results/detail-quick.json
	$(BIN)/python benchmarks/calibration.py --quick --json benchmarks/results/calibration-quick.json
	$(BIN)/python benchmarks/realbench.py --json benchmarks/results/realbench.json
	$(BIN)/python benchmarks/viewer.py --json benchmarks/results/viewer.json
	$(BIN)/python benchmarks/everyday.py --json benchmarks/results/everyday.json
	$(BIN)/python benchmarks/everyday.py --quick --json benchmarks/results/everyday-quick.json
	$(BIN)/python benchmarks/scale.py --only costs --json benchmarks/results/scale.json
	$(BIN)/python benchmarks/scale.py --only scheduling --json benchmarks/results/scale-scheduling.json
	$(BIN)/python benchmarks/large.py --quick --json benchmarks/results/large-quick.json
	$(BIN)/python benchmarks/tables.py

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
