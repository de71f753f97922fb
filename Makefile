# Each target makes the virtual environment that it needs, then runs. Two of them matter: `make demo`, `make test`.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
JOBS ?= auto

.PHONY: demo test lint judges clean
.DEFAULT_GOAL := help

help:
	@echo "make demo    a simulated bridge through real ports, 60 s, with picture and files in demo-out/"
	@echo "make test    lint, types and all tests"
	@echo "make judges  our files before readers that nobody here wrote (rerun, @mcap/core)"

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

demo: $(VENV)/.demo
	$(BIN)/edge-agent demo -o demo-out

lint: $(VENV)/.test
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

test: lint
	$(BIN)/pytest -n $(JOBS) -q

judges: $(VENV)/.judges
	$(BIN)/python tests/judges/run.py

clean:
	rm -rf $(VENV) demo-out build *.egg-info
