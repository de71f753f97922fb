# Each target makes the virtual environment that it needs, then runs. Two of them matter: `make demo`, `make test`.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
JOBS ?= auto
FAULTS ?= all

.PHONY: demo test lint bench judges real vm-test power-test kill-test fuzz soak clean
.DEFAULT_GOAL := help

help:
	@echo "make demo    a simulated bridge through real ports, 60 s, with picture and files in demo-out/"
	@echo "make test    lint, types and all tests"
	@echo "make bench   figures against their goals; ROWS=filter,replay chooses, COMPARE=<commit> runs two checkouts in turn"
	@echo "make judges  our files before readers that nobody here wrote (rerun, @mcap/core)"
	@echo "make real    whole real records through import, replay and review; minutes, needs ../shared/data"
	@echo "make kill-test   KILLS=20 SIGKILLs under load, every file recovered and judged; flipped bits too"
	@echo "make fuzz        MINUTES=1 of spoilt input for each parser; TARGETS=nmea,mcap chooses"
	@echo "make soak        a simulated month of recording in at most MINUTES=120: memory, descriptors, threads stand still"
	@echo "make power-test  CUTS=5 power cuts of the virtual machine under load; about 1.5 minutes each, and 4 to install"
	@echo "make vm-test     the service in a virtual machine, with a table of faults; 15 minutes, 6 with FAULTS=few"

$(VENV)/.demo: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check --editable '.[demo]'
	touch $@

$(VENV)/.test: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check --editable '.[test]'
	touch $@ $(VENV)/.demo

$(VENV)/.judges: $(VENV)/.test
	$(BIN)/pip install --quiet --disable-pip-version-check --editable '.[judges]'
	touch $@

# What cannot be installed here is a column that says so, not an error.
$(VENV)/.bench: $(VENV)/.demo
	$(BIN)/pip install --quiet --disable-pip-version-check --editable '.[bench]' || echo "bench: some peers are missing"
	touch $@

demo: $(VENV)/.demo
	$(BIN)/edge-agent demo -o demo-out

lint: $(VENV)/.test
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

test: lint
	$(BIN)/pytest -n $(JOBS) -q

bench: $(VENV)/.bench
	$(BIN)/python tests/bench/run.py $(if $(ROWS),--rows $(ROWS)) $(if $(COMPARE),--compare $(COMPARE)) $(if $(DAY),--day $(filter-out 1,$(DAY))) $(BENCH)

judges: $(VENV)/.judges
	$(BIN)/python tests/judges/run.py

real: $(VENV)/.test
	nice -n 10 $(BIN)/pytest -q tests/review/real_whole.py

KILLS ?= 20
comma := ,
kill-test: $(VENV)/.test
	nice -n 10 $(BIN)/python tests/faults/flips.py 10000
	nice -n 10 $(BIN)/python tests/faults/kills.py $(KILLS)

fuzz: $(VENV)/.test
	nice -n 10 $(BIN)/python tests/fuzz/fuzz.py $(or $(MINUTES),1) $(subst $(comma), ,$(TARGETS))

soak: $(VENV)/.test
	nice -n 10 $(BIN)/python tests/faults/soak.py $(or $(MINUTES),120)

CUTS ?= 5
power-test: $(VENV)/.test
	$(BIN)/python tests/vm/power.py $(CUTS)

vm-test: $(VENV)/.test
	nice -n 10 $(BIN)/python tests/vm/run.py --faults $(FAULTS)

clean:
	rm -rf $(VENV) demo-out build *.egg-info
