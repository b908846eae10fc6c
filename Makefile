# make demo | test | test-slow | lint | setup; another Python: make PYTHON=python3.12 ...
PYTHON ?= python3
BIN := .venv/bin
STAMP := .venv/.installed

.PHONY: demo test test-slow lint setup

demo: setup
	@$(BIN)/python examples/01_demo.py --out out/demo

test: lint
	@echo "Running the tests ..."
	@$(BIN)/python -m pytest -q -n 2 --dist loadgroup -m "not slow"

test-slow: setup
	@echo "Running the slow tests ..."
	@$(BIN)/python -m pytest -q -n 2 --dist loadgroup -m slow

lint: setup
	@echo "Checking style and types ..."
	@$(BIN)/ruff check --quiet .
	@$(BIN)/ruff format --check --quiet .
	@$(BIN)/mypy

setup: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "dexzoo needs Python 3.11 or newer; name one with make PYTHON=python3.11" >&2; exit 1; }
	@echo "Creating .venv with $$($(PYTHON) --version) ..."
	@$(PYTHON) -m venv .venv
	@echo "Installing the packages pinned in constraints.txt, two to three minutes ..."
	@$(BIN)/python -m pip install -qq --disable-pip-version-check -c constraints.txt -e ".[dev,viewer]"
	@touch $@
