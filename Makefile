# `make demo` and `make test` each prepare everything they need, on a machine with Python 3.11 and nothing else.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: env demo test lint audit
env: .venv/ready

# torch first and pinned: an open range pulls several GB of CUDA packages.
.venv/ready: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check torch==2.13.0
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[sim,view,sam,planning,ros,lerobot,dev]'
	touch $@

demo: .venv/ready
	$(BIN)/python examples/demo.py

test: .venv/ready
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist loadfile

lint: .venv/ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

audit: .venv/ready
	$(BIN)/bandit --quiet --recursive src --configfile pyproject.toml --severity-level medium
	$(BIN)/python .ci/audit.py
