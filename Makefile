# Two commands do all the set-up: `make run` and `make test`. Both work from a fresh clone.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt

.PHONY: run test lint docs bench scaling numerics pictures schema clean

run: $(VENV)/.installed
	$(BIN)/egvs run scenarios/nishishinjuku

# Compiled kernels are removed first: numba does not notice when a kernel that another one calls has changed.
test: $(VENV)/.installed-dev
	@find pipeline/kernels -name '*.nb[ci]' -delete
	$(BIN)/python -m pytest

lint: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

docs: $(VENV)/.installed-docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --config-file docs/mkdocs/mkdocs.yml

bench: $(VENV)/.installed-dev
	$(BIN)/python -m benchmarks

scaling: $(VENV)/.installed-dev
	$(BIN)/python -m benchmarks.scaling

numerics: $(VENV)/.installed-dev
	$(BIN)/python -m benchmarks.numerics --markdown docs/numerics-table.md

pictures: $(VENV)/.installed-dev
	$(BIN)/python -m benchmarks.pictures

schema: $(VENV)/.installed
	$(BIN)/python -c "from pipeline.scenario.loading import json_schema; print(json_schema(), end='')" > data_schemas/scenario.schema.json

$(VENV)/.installed: pyproject.toml constraints.txt
	@$(PYTHON) -c "import sys; sys.exit(sys.version_info < (3, 11) and 'egvs needs Python 3.11 or newer; name one with: make PYTHON=...')"
	$(PYTHON) -m venv $(VENV)
	$(INSTALL) hatchling editables
	$(INSTALL) --no-build-isolation --editable .
	@touch $@

$(VENV)/.installed-dev: $(VENV)/.installed
	$(INSTALL) --no-build-isolation --editable '.[dev]'
	@touch $@

$(VENV)/.installed-docs: $(VENV)/.installed
	$(INSTALL) --no-build-isolation --editable '.[docs]'
	@touch $@

clean:
	rm -rf $(VENV) runs build
