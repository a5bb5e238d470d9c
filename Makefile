# make test   every check: lint, types, tests
# make demo   train a tiny model, export it, restore a clip: outputs/demo/
# make lint | types | unit | slow | dist | clean

PYTHON ?= python3.11
VENV ?= .venv
BIN := $(VENV)/bin

.PHONY: test demo lint types unit slow dist clean

test: lint types unit

$(VENV)/.installed: pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -e '.[dev]'
	touch $@

lint: $(VENV)/.installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/.installed
	$(BIN)/mypy

unit: $(VENV)/.installed
	$(BIN)/python -m pytest -q -n auto

slow: $(VENV)/.installed
	$(BIN)/python -m pytest -q -n auto -m slow

demo: $(VENV)/.installed
	$(BIN)/python tools/demo.py

dist: $(VENV)/.installed
	$(BIN)/python -m build

clean:
	rm -rf $(VENV) build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache
