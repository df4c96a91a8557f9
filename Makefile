# What one does with a checkout; `make help` lists it. Needs python3 with venv, and make.

PYTHON ?= python3
DATA ?= demo
GROUNDTRUTH ?=
ARGS ?=
PIP_ARGS ?=

VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check

# A file of tests stays on one core, so that what its tests share is made once. Files are dealt out
# in the order of tests/conftest.py, long ones first, instead of by their number of tests.
PARALLEL ?= -n logical --dist loadfile --no-loadscope-reorder

# Matrices here are a few hundred wide: threads of BLAS cost more than they bring.
export OPENBLAS_NUM_THREADS ?= 1

.DEFAULT_GOAL := help
.PHONY: help demo test slow lint types check format docs bench gate tables clean

help:  ## List these commands
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "make %-8s %s\n", $$1, $$2 }' Makefile

demo: $(VENV)/.installed  ## Run on the recording that comes along (DATA=path for another one)
	@$(BIN)/slam-graph run "$(DATA)" $(if $(GROUNDTRUTH),--groundtruth "$(GROUNDTRUTH)") $(ARGS)
	@echo
	@$(BIN)/slam-graph compare "$(DATA)" $(if $(GROUNDTRUTH),--groundtruth "$(notdir $(DATA))=$(GROUNDTRUTH)") \
		--algorithms ekf,iekf,msckf,swf,okvis --output results/comparison --no-progress

test: $(VENV)/.installed-dev  ## Run the quick tests (SLAM_GRAPH_DATA=folder for those on recordings)
	@$(BIN)/python -m pytest $(PARALLEL) $(ARGS)

slow: $(VENV)/.installed-dev  ## Run the slow tests, which `make test` leaves out
	@$(BIN)/python -m pytest $(PARALLEL) -m slow $(ARGS)

lint: $(VENV)/.installed-dev  ## Check style and formatting
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .

types: $(VENV)/.installed-dev  ## Check types
	@$(BIN)/mypy

check: lint types test  ## Check style and types, and run the quick tests

format: $(VENV)/.installed-dev  ## Put the sources into the agreed format
	@$(BIN)/ruff check --fix .
	@$(BIN)/ruff format .

docs: $(VENV)/.installed-docs  ## Write the pages of settings anew and build the site in build/site
	@$(BIN)/python docs/generate_configuration.py
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

bench: $(VENV)/.installed  ## Measure accuracy and speed
	@$(BIN)/python -m benchmarks.run $(ARGS)

gate: $(VENV)/.installed  ## Run the quick benchmarks; fail if a figure is worse than the baseline
	@$(BIN)/python -m benchmarks.run --quick --gate --workers 2 $(ARGS)

tables: $(VENV)/.installed  ## Write the tables of the documents from benchmarks/baseline.json
	@$(BIN)/python -m benchmarks.tables

clean:  ## Remove what was built, installed and cached, but no results
	rm -rf $(VENV) build dist .pytest_cache .hypothesis .mypy_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# The stamps: installed again only when a requirement or a pin has changed. The second installation
# contains the others, the third the first.

$(VENV)/.installed: pyproject.toml constraints.txt
	@$(call install,.)
	@touch $@

$(VENV)/.installed-dev: pyproject.toml constraints.txt
	@$(call install,.[dev])
	@touch $(VENV)/.installed $(VENV)/.installed-docs $@

$(VENV)/.installed-docs: pyproject.toml constraints.txt
	@$(call install,.[docs])
	@touch $(VENV)/.installed $@

define install
$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
  echo "error: slam_graph needs Python 3.11 or newer, $(PYTHON) is not; say PYTHON=path" >&2; exit 1; } ; \
echo "Installing into $(VENV); the first time takes a minute or two." >&2; \
$(PYTHON) -m venv $(VENV) && $(PIP) install --quiet $(PIP_ARGS) -c constraints.txt -e '$(1)'
endef
