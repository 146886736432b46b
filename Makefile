# The project's commands. Each makes .venv when it is missing; needed are python3 with its venv module, and make.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
EXAMPLE := data/gold-ball

.PHONY: fit test check notebooks clean

fit: $(VENV)/installed
	$(BIN)/brdf fit $(EXAMPLE) --out out/gold-ball --plot

test: $(VENV)/installed-tests
	$(BIN)/python -m pytest -n auto --dist loadfile

check: $(VENV)/installed-tests
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --pythonpath $(BIN)/python

notebooks: $(VENV)/installed-notebooks
	printf '%s\n' 5 1 2 3 4 6 7 | xargs -P 2 -n 1 $(BIN)/python notebooks/run.py

$(VENV)/installed: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e .
	touch $@

$(VENV)/installed-tests: $(VENV)/installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[tests,check,interop,measured,meshes]'
	touch $@

$(VENV)/installed-notebooks: $(VENV)/installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[notebooks]'
	touch $@

clean:
	rm -rf $(VENV) out
