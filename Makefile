# make demo | test | lint: each makes .venv and installs what it needs. Your pip settings (PIP_*) are honoured.
SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help

VENV ?= .venv
PYTHON ?= $(shell for p in python3 python3.13 python3.12 python3.11 python; do \
	$$p -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 14))' 2>/dev/null && { echo $$p; break; }; done)
WORKERS ?= 2
DEMO_OUT ?= out/demo
NOTEBOOKS := $(notdir $(basename $(wildcard notebooks/*.py)))

PIP := $(VENV)/bin/python -m pip install --quiet --disable-pip-version-check -c constraints.txt

.PHONY: help demo test lint unit notebook clean

help:
	@echo "make demo   fit the bundled photo into $(DEMO_OUT) (open report.html there)"
	@echo "make test   everything CI runs: lint, tests, notebook"
	@echo "make lint   ruff, import contracts, types"

$(VENV)/bin/python:
	@test -n "$(PYTHON)" || { echo "make: no Python 3.11-3.13 found; say PYTHON=/path/to/python3" >&2; exit 2; }
	$(PYTHON) -m venv $(VENV)

# Stamps: an install is redone when what it was made from changed.
$(VENV)/.installed: pyproject.toml constraints.txt | $(VENV)/bin/python
	$(PIP) -e .
	@touch $@

$(VENV)/.installed-dev: pyproject.toml constraints.txt | $(VENV)/bin/python
	$(PIP) -e '.[dev]'
	@touch $(VENV)/.installed $@

demo: $(VENV)/.installed
	$(VENV)/bin/recon photo examples/photos/man-hoodie-trousers.jpg --garments top,trousers --out $(DEMO_OUT)

test: lint unit notebook

lint: $(VENV)/.installed-dev
	$(VENV)/bin/ruff check .
	$(VENV)/bin/lint-imports --no-logo
	$(VENV)/bin/mypy

# One thread a worker: torch, OpenMP and numpy would otherwise fight over the cores that the workers share.
unit: $(VENV)/.installed-dev
	OMP_NUM_THREADS=1 $(VENV)/bin/python -m pytest -n $(WORKERS) --dist loadfile --durations 15 -q

notebook: $(VENV)/.installed-dev
	mkdir -p out
	for n in $(NOTEBOOKS); do $(VENV)/bin/jupytext --quiet --to ipynb --output out/$$n.ipynb notebooks/$$n.py; done
	GARMENT_RECON_NOTEBOOK=quick $(VENV)/bin/python -m pytest -q -p no:cacheprovider --nbmake --nbmake-timeout 900 \
		$(NOTEBOOKS:%=out/%.ipynb)

clean:
	rm -rf $(VENV) out .pytest_cache .mypy_cache .ruff_cache .import_linter_cache
