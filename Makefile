# Two commands: `make reproduce` and `make test`. Everything else is a convenience.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet

.PHONY: reproduce test bench docs lock clean

reproduce: $(VENV)/.lab
	$(BIN)/uard reproduce --report report

test: $(VENV)/.test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports --no-cache
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	$(BIN)/pytest -n 2 --dist worksteal

bench: $(VENV)/.test
	$(BIN)/python benchmarks/bench.py

docs: $(VENV)/.test
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

$(VENV)/bin/python:
	$(PYTHON) -m venv $(VENV)

$(VENV)/.lab: requirements/lab.txt pyproject.toml | $(VENV)/bin/python
	@echo "Installing locked dependencies into $(VENV) ..."
	$(PIP) install -r requirements/lab.txt
	$(PIP) install --no-deps --no-build-isolation --editable .
	@touch $@

# torch first and pinned: a CPU build, where one is at hand, must not be replaced by a newer CUDA build.
$(VENV)/.test: $(VENV)/.lab requirements/test.txt requirements/torch.txt requirements/sb3.txt requirements/trl.txt \
		requirements/ray.txt requirements/verifiers.txt
	@echo "Installing what the tests need ..."
	$(PIP) install -r requirements/torch.txt
	$(PIP) install -r requirements/test.txt
	$(PIP) install --no-deps -r requirements/sb3.txt
	$(PIP) install --no-deps -r requirements/trl.txt
	$(PIP) install --no-deps -r requirements/ray.txt
	$(PIP) install --no-deps -r requirements/verifiers.txt
	@touch $@

lock: $(VENV)/bin/python
	$(PIP) install uv
	$(BIN)/uv pip compile --universal --python-version 3.11 --no-emit-index-url --no-emit-find-links --no-annotate \
		--custom-compile-command "make lock" --extra lab pyproject.toml requirements/build.in -o requirements/lab.txt
	$(BIN)/uv pip compile --universal --python-version 3.11 --no-emit-index-url --no-emit-find-links --no-annotate \
		--custom-compile-command "make lock" -c requirements/lab.txt requirements/test.in -o requirements/test.txt

clean:
	rm -rf $(VENV) report results
