# Two commands on a fresh machine: `make demo` and `make test`. Each installs what it needs into .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
OUT ?= demo-out
TESTS ?= tests
STAMP := $(VENV)/.installed
PEERS := $(VENV)/.installed-peers

.PHONY: demo test test-vm lint slow docs evidence clean

$(STAMP): pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "wingshape needs Python 3.11 or newer: make PYTHON=/path/to/python3.11 ..."; exit 1; }
	@$(PYTHON) -m venv $(VENV) || { echo "python venv is missing: trying the system package"; apt-get update && apt-get install -y python3-venv && $(PYTHON) -m venv $(VENV); }
	$(BIN)/pip install --quiet --disable-pip-version-check -e '.[dev]'
	@touch $@

$(PEERS): $(STAMP)
	$(BIN)/pip install --quiet --disable-pip-version-check -e '.[dev,peers]'
	@touch $@

demo: $(STAMP)
	$(BIN)/wingsim demo -o $(OUT)

# What only computes runs on all cores. What keeps time runs alone, and what failed of it, on a computer that was perhaps
# busy for a moment, is tried once more; both are shown.
COMPUTING := tests/process tests/reconstruct tests/project
KEEPING_TIME := $(filter-out $(COMPUTING),$(wildcard tests/*)) tests/process/monitor
AGAIN := --last-failed --last-failed-no-failures none
test: $(STAMP) lint
	OPENBLAS_NUM_THREADS=1 $(BIN)/pytest -m "not slow" --numprocesses auto --dist loadfile $(COMPUTING) --ignore tests/process/monitor
	$(BIN)/pytest -m "not slow" $(KEEPING_TIME) || $(BIN)/pytest -m "not slow" $(AGAIN) $(KEEPING_TIME)

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

test-vm: $(STAMP) # drivers and power cuts on a Debian kernel in QEMU
	$(BIN)/pytest tests/vm

slow: $(PEERS)
	$(BIN)/pytest -m slow $(TESTS) || $(BIN)/pytest -m slow $(AGAIN) $(TESTS)

docs: $(STAMP)
	$(BIN)/python tests/support/command_reference.py

evidence: $(PEERS)
	$(BIN)/python tests/evidence/collect.py

clean:
	rm -rf $(VENV) $(OUT)
