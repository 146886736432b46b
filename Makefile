# The project's commands. Each makes .venv when it is missing; needed are python3 with its venv module, and make.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
EXAMPLE := data/gold-ball

.PHONY: fit test check docs lab clean

fit: $(VENV)/installed
	$(BIN)/brdf fit $(EXAMPLE) --out out/gold-ball --plot

test: $(VENV)/installed-tests
	$(BIN)/python -m pytest -n auto --dist loadfile

check: $(VENV)/installed-tests
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --pythonpath $(BIN)/python

docs: $(VENV)/installed-docs
	$(BIN)/python -m sphinx --fail-on-warning --keep-going -q -j 2 -b html -d out/docs-cache docs out/docs

lab: $(VENV)/installed-lab
	JUPYTER_CONFIG_PATH=$(CURDIR)/$(VENV)/lab $(BIN)/jupyter lab notebooks

$(VENV)/installed: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e .
	touch $@

$(VENV)/installed-tests: $(VENV)/installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[tests,check,interop,measured,meshes]'
	touch $@

$(VENV)/installed-docs: $(VENV)/installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[docs]'
	touch $@

$(VENV)/installed-lab: $(VENV)/installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[lab]'
	$(BIN)/jupytext-config --settings-file $(VENV)/lab/labconfig/default_setting_overrides.json set-default-viewer python
	touch $@

clean:
	rm -rf $(VENV) out
