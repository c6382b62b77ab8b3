# After the install line of README.md. `make check` is what a change must pass; .ci/run does it from nothing, with the slow tests.
PYTHON ?= .venv/bin/python
# Processes that share the quick tests, file by file (some folder by folder: tests/conftest.py), so that what these set up is set up once.
# One takes up to 6 GB.
WORKERS ?= 2

.PHONY: check lint format test test-all docs dist bundles

check: lint test

lint:
	$(PYTHON) -m ruff check .
	$(PYTHON) -m mypy

format:
	$(PYTHON) -m ruff check --select I --fix .

test:
	$(PYTHON) -m pytest -q -m "not slow" -n $(WORKERS) --dist loadfile

test-all:
	$(PYTHON) -m pytest -q

docs:
	$(PYTHON) docs/site.py

# Needs `pip install build`; the wheel holds experts and bundles, so that its first command works from any folder.
dist:
	$(PYTHON) -m build

# The bundles that come with the package, anew from a finished run: each is exported and proven before any is replaced.
#     make bundles RUN=logs/my-run [TARGETS="jaco iiwa"] [STRESSED=folder of stress tests, one by each target's name]
TARGETS ?= jaco kinova3 iiwa
bundles:
	@test -n "$(RUN)" || { echo "which run? make bundles RUN=logs/my-run" >&2; exit 2; }
	folder=$$(mktemp -d) && trap 'rm -r "$$folder"' EXIT && for target in $(TARGETS); do \
		$(PYTHON) -m toolkit.cli export "$(RUN)" --target $$target --out "$$folder/$$target" $(if $(STRESSED),--stressed "$(STRESSED)/$$target") && \
		$(PYTHON) -m toolkit.cli verify "$$folder/$$target.zip" || exit 1; done && cp "$$folder"/*.zip toolkit/bundle/shipped/
