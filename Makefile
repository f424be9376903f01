# make demo   sets up, makes a small mission, maps it and says where to look
# make test   sets up, runs the tests (make test-all: the slow ones too, with their coverage)
# make setup  leaves .venv/bin/seamosaic
# make lock   renews requirements.lock after a change to pyproject.toml

PYTHON ?= python3.11
VENV := .venv
BIN := $(VENV)/bin
# the certificates of the machine, not uv's own; pip takes over where uv cannot reach the index. Compiled as pip does it,
# once: else each process does, 8 seconds, where the environment says PYTHONDONTWRITEBYTECODE
INSTALL := $(BIN)/uv pip install --quiet --system-certs --python $(BIN)/python

# small matrices, two test processes: threads of the linear algebra would only wait for each other
export OPENBLAS_NUM_THREADS := 1
export OMP_NUM_THREADS := 1
export MPLCONFIGDIR := $(CURDIR)/$(VENV)/matplotlib

.PHONY: demo test test-all lint setup lock clean

setup: $(VENV)/.ready

$(VENV)/.ready: requirements.lock requirements-uv.lock pyproject.toml
	$(PYTHON) -m venv --clear $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check --require-hashes -r requirements-uv.lock
	$(INSTALL) --compile-bytecode --require-hashes -r requirements.lock || $(BIN)/pip install --quiet --require-hashes -r requirements.lock
	$(INSTALL) --no-deps --no-build-isolation --editable .
	touch $@

demo: setup
	$(BIN)/seamosaic demo demo

test: setup lint
	$(BIN)/python -m pytest -n 2 --dist worksteal -m "not slow"

test-all: setup lint
	$(BIN)/python -m pytest -n 2 --dist worksteal --cov --cov-report=term

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --pythonpath $(BIN)/python

lock:
	$(PYTHON) -m venv --clear build/lock
	build/lock/bin/pip install --quiet uv
	build/lock/bin/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes \
		--extra dev --no-emit-index-url --no-annotate --custom-compile-command "make lock" \
		pyproject.toml -o requirements.lock
	echo uv | build/lock/bin/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes \
		--no-emit-index-url --no-annotate --custom-compile-command "make lock" - -o requirements-uv.lock

clean:
	rm -rf $(VENV) demo build *.egg-info .pytest_cache .ruff_cache .hypothesis .coverage*
