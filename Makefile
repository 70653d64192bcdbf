# Two commands do all the set-up: `make run` and `make test`. Both work from a fresh clone.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt

.PHONY: run test test-slow test-train test-lowest test-portable unit lint bench bench-peers scaling numerics validity detectability pictures schema reference docs fuzz clean

run: $(VENV)/.installed
	$(BIN)/egvs run scenarios/nishishinjuku

test: $(VENV)/.installed-dev
	$(BIN)/python -m pytest -m "not slow" --ignore=tests/validation/training

# Sweeps, whole studies, browsers, kills: what takes more than some tenths of a second each.
test-slow: $(VENV)/.installed-dev
	$(BIN)/python -m pytest -m slow --ignore=tests/validation/training

# PyTorch is large, and only those who train a detector need it.
test-train: $(VENV)/.installed-train
	$(BIN)/python -m pytest -n 0 tests/validation/training

# The lowest versions that pyproject.toml allows, in an environment of its own. Old libraries warn about newer ones.
test-lowest: $(VENV)/.installed
	mkdir -p build
	$(BIN)/python .ci/lowest.py > build/lowest.txt
	$(PYTHON) -m venv --clear build/lowest
	build/lowest/bin/python -m pip install --quiet --disable-pip-version-check --constraint build/lowest.txt \
		'.[place]' hypothesis mpmath pytest pytest-xdist
	build/lowest/bin/python -m pytest -m unit -p no:cacheprovider -W ignore::DeprecationWarning tests/core tests/scenario tests/scoring tests/sensors tests/world

# The unit tests without the modules and flags that only POSIX systems have.
test-portable: $(VENV)/.installed-dev
	$(BIN)/python -m pytest -m unit -p tests.without_posix --ignore=tests/validation/training

# The quick loop: no other program is started, nothing takes long.
unit: $(VENV)/.installed-dev
	$(BIN)/python -m pytest -m unit

lint: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-cache

docs: $(VENV)/.installed-docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --config-file docs/mkdocs/mkdocs.yml

bench: $(VENV)/.installed-dev
	$(BIN)/python -m benchmarks

# Peers that are not installed are left out by name; "pip install egvs[peers]" installs them, Open3D alone takes 900 MB.
bench-peers: $(VENV)/.installed-dev
	$(BIN)/python -m benchmarks.peers

scaling: $(VENV)/.installed-dev
	$(BIN)/python -m benchmarks.scaling
	$(BIN)/python -m benchmarks.city speed
	$(BIN)/python -m benchmarks.city overhead
	$(BIN)/python -m benchmarks.city flat
	$(BIN)/python -m benchmarks.town_traffic

numerics: $(VENV)/.installed-dev
	$(BIN)/python -m benchmarks.numerics --markdown docs/numerics-table.md

# OSM_TRAINING, OSM_HELD_OUT: OpenStreetMap extracts; OSM_TRAINING_AT: lat,lon of a junction; VALIDITY: further options
validity: $(VENV)/.installed-dev
	$(BIN)/python -m benchmarks.validity $(if $(OSM_TRAINING),--osm-training $(OSM_TRAINING)) \
		$(if $(OSM_TRAINING_AT),--osm-training-at $(OSM_TRAINING_AT)) $(if $(OSM_HELD_OUT),--osm-held-out $(OSM_HELD_OUT)) \
		$(if $(OSM_UNSEEN),--osm-unseen $(OSM_UNSEEN)) $(if $(OSM_UNSEEN_AT),--osm-unseen-at $(OSM_UNSEEN_AT)) $(VALIDITY)

# OSM_TRAINING, OSM_TRAINING_AT as above; DETECTABILITY: further options
detectability: $(VENV)/.installed-dev
	$(BIN)/python -m benchmarks.detectability $(if $(OSM_TRAINING),--osm-training $(OSM_TRAINING)) \
		$(if $(OSM_TRAINING_AT),--osm-training-at $(OSM_TRAINING_AT)) $(DETECTABILITY)

pictures: $(VENV)/.installed-dev
	$(BIN)/python -m benchmarks.pictures

# FUZZ: options, as in FUZZ="--cases 10000 --seed 2"; what is bad lies in build/fuzz
fuzz: $(VENV)/.installed-dev
	$(BIN)/python -m tests.fuzz $(FUZZ)

schema: $(VENV)/.installed
	$(BIN)/python -c "from egvs.scenario.loading import json_schema; print(json_schema(), end='')" > data_schemas/scenario.schema.json
	$(BIN)/python -c "from egvs.city.model import city_json_schema; print(city_json_schema(), end='')" > data_schemas/city_file.schema.json

# The reference pages: every scenario key, every artefact column. Run it after `make schema`.
reference: $(VENV)/.installed
	$(BIN)/python docs/mkdocs/reference.py

$(VENV)/.installed: pyproject.toml constraints.txt
	@$(PYTHON) -c "import sys; sys.exit(sys.version_info < (3, 11) and 'egvs needs Python 3.11 or newer; name one with: make PYTHON=...')"
	$(PYTHON) -m venv $(VENV)
	$(INSTALL) hatchling editables
	$(INSTALL) --no-build-isolation --editable '.[explore]'
	@touch $@

$(VENV)/.installed-dev: $(VENV)/.installed
	$(INSTALL) --no-build-isolation --editable '.[dev]'
	@touch $@

$(VENV)/.installed-train: $(VENV)/.installed-dev
	$(INSTALL) --no-build-isolation --editable '.[dev,train]'
	@touch $@

$(VENV)/.installed-docs: $(VENV)/.installed
	$(INSTALL) --no-build-isolation --editable '.[docs]'
	@touch $@

clean:
	rm -rf $(VENV) runs build
