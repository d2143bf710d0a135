# Each target does all the set-up it needs; a second call installs nothing.
PY := .venv/bin/python
ONLY ?=

.PHONY: help demo test lint bench petals lock use dev clean

help:
	@echo "make demo     the whole chain on the simulated bench"
	@echo "make test     all tests"
	@echo "make lint     ruff, mypy, import rules"
	@echo "make bench    benchmarks, all or one: make bench ONLY=name"
	@echo "make petals   trace the virtual petals again"
	@echo "make lock     resolve the lock files again (needs uv)"
	@echo "make clean    remove .venv and caches"

use:
	@.ci/setup use

dev:
	@.ci/setup test

demo: use
	@.venv/bin/rig demo

test: dev
	@$(PY) -m pytest -n 3 --dist=loadfile  # three on two cores: many tests wait for stages that move

lint: dev
	@$(PY) -m ruff check .
	@$(PY) -m ruff format --check .
	@$(PY) -m mypy
	@.venv/bin/lint-imports

bench: dev
	@$(PY) -m tests.benchmarks $(ONLY)

petals: use
	@$(PY) -m sim.petals

LOCK := uv pip compile --universal --python-version 3.11 --generate-hashes --no-emit-index-url --no-annotate --no-header --quiet
lock:
	$(LOCK) pyproject.toml -o requirements.lock
	$(LOCK) --extra test --extra viewer --extra photoreal pyproject.toml tests/peers.in -c requirements.lock -o tests/requirements.lock
	$(LOCK) --no-deps tests/peers-nodeps.in >> tests/requirements.lock

clean:
	rm -rf .venv .mypy_cache .ruff_cache .pytest_cache build *.egg-info
