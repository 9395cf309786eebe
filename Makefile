# `make demo` and `make test` each prepare everything they need, on a machine with Python 3.11 and nothing else.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: env demo test test-fast test-long test-lowest lint audit docs dist
env: .venv/ready

# torch first and pinned: an open range pulls several GB of CUDA packages.
.venv/ready: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check torch==2.13.0
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[all,dev]'
	$(BIN)/python -m jcr.depth  # compiles its loops, or the first run would
	touch $@
	@echo "prepared. To have the jcr command in this shell:  . .venv/bin/activate"

demo: .venv/ready
	$(BIN)/python examples/demo.py $(BACKEND)

# Files in the order of tests/conftest.py, slow ones first.
TWO_WORKERS := -n 2 --dist loadfile --no-loadscope-reorder
# Where bytecode is not kept, each of the many processes that tests start compiles all of jcr: a second, half of a start.
test test-fast test-long test-lowest: export PYTHONDONTWRITEBYTECODE :=

test: .venv/ready
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest $(TWO_WORKERS)

test-fast: .venv/ready
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest $(TWO_WORKERS) -m "not slow"

# Fuzzing, kills, browsers and repeats of more than ten seconds each.
test-long: .venv/ready
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest $(TWO_WORKERS) -m long

# The core with the lowest versions of its packages, and without torch.
test-lowest: .venv-lowest/ready
	OMP_NUM_THREADS=1 .venv-lowest/bin/python -m pytest $(TWO_WORKERS) -o addopts='--import-mode=importlib -ra' \
		tests/test_without_torch.py tests/test_api.py tests/test_geometry.py tests/test_camera.py \
		tests/estimation tests/calibration tests/capture tests/boards/test_marker.py tests/pointmaps/test_image_grid.py

.venv-lowest/ready: pyproject.toml constraints-lowest.txt
	$(PYTHON) -m venv .venv-lowest
	.venv-lowest/bin/pip install --quiet --disable-pip-version-check -c constraints-lowest.txt -e '.[ros,lerobot]' \
		pytest pytest-xdist hypothesis
	touch $@

lint: .venv/ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports

# Warnings are errors: links and anchors that lead nowhere, too.
docs: .venv-docs/ready
	OMP_NUM_THREADS=1 .venv-docs/bin/python -m sphinx -b html -W --keep-going -q docs docs/_site

.venv-docs/ready: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv-docs
	.venv-docs/bin/pip install --quiet --disable-pip-version-check torch==2.13.0
	.venv-docs/bin/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[docs]'
	touch $@

# Wheel and source, checked as a package index checks them.
dist: docs
	$(PYTHON) -m venv .venv-dist
	.venv-dist/bin/pip install --quiet --disable-pip-version-check build twine
	rm -rf dist
	.venv-dist/bin/python -m build --outdir dist .
	.venv-dist/bin/python -m twine check --strict dist/*

audit: .venv/ready
	$(BIN)/bandit --quiet --recursive src --configfile pyproject.toml --severity-level medium
	$(BIN)/python .ci/audit.py
