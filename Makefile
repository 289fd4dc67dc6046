# spherecal: `make demo` and `make test` need nothing but make, git and Python 3.11 or 3.12.
# Another interpreter: make demo PYTHON=/path/to/python3.12

VENV := .venv
BIN := $(VENV)/bin
# Two test processes: the suite is bound by the processor, and the target machine has two cores.
JOBS ?= 2
DEMO_OUT ?= demo

.DEFAULT_GOAL := help
.PHONY: help demo test lint qualify bench clean system
.DELETE_ON_ERROR:

help:
	@echo "make demo     install, then run the whole way on a simulated cell; results in $(DEMO_OUT)/"
	@echo "make test     install, then ruff, mypy --strict, import contracts, pytest"
	@echo "make qualify  full Monte-Carlo, kill and fault counts (long; seeds printed)"
	@echo "make bench    timings; the only target that judges time"
	@echo "make clean    remove the environment, caches and demo results"

# The environment follows pyproject.toml and nothing else; the packages are installed editable.
$(VENV)/.installed: pyproject.toml tools/environment.sh | system
	@PYTHON="$(PYTHON)" sh tools/environment.sh create $(VENV)
	@echo "Installing spherecal and what it needs into $(VENV) (about 1.8 GB; some minutes the first time) ..."
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable .
	@touch $@

$(VENV)/.installed-dev: $(VENV)/.installed
	@echo "Installing the tools of the checks ..."
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	@touch $@

system:
	@PYTHON="$(PYTHON)" sh tools/environment.sh system

demo: $(VENV)/.installed
	$(BIN)/spherecal demo --out $(DEMO_OUT) --force

lint: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# One BLAS thread a process: two processes share two cores, and on matrices this small more threads gain nothing and were seen to stall.
# Idle workers take over what busy ones have not begun: some tests wait for seconds, others compute.
# Types are checked beside the tests: alone, mypy leaves one core idle. Either of the two fails the whole.
test: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/lint-imports
	$(BIN)/mypy & types=$$!; OPENBLAS_NUM_THREADS=1 $(BIN)/pytest -n $(JOBS) --dist worksteal; tests=$$?; wait $$types && exit $$tests

qualify: $(VENV)/.installed-dev
	$(BIN)/pytest -m qualify -s

bench: $(VENV)/.installed-dev
	$(BIN)/pytest -m bench -s

clean:
	rm -rf $(VENV) $(DEMO_OUT) build dist .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
	find drivers acquire calibrate measure tests tools -name __pycache__ -type d -prune -exec rm -rf {} +
