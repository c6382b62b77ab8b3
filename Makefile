# After the install line of README.md. `make check` is what a change must pass; .ci/run does it from nothing.
PYTHON ?= .venv/bin/python

.PHONY: check lint format test

check: lint test

lint:
	$(PYTHON) -m ruff check .

format:
	$(PYTHON) -m ruff check --select I --fix .

test:
	$(PYTHON) -m pytest -q
