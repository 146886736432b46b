# The project's commands. Each makes .venv when it is missing; needed are python3 with its venv module, and make.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
EXAMPLE := data/gold-ball
# The compiler is most of the tests' time, and takes a third of its own with these. What they leave out these tests run
# through: fits of what other programs and closed forms draw, sums, searches, the bundled example.
LIGHTLY_COMPILED = $(OLD_EMITTERS) --xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true \
	--xla_cpu_parallel_codegen_split_count=1
# From 0.11 on XLA has no others than the fusion emitters, and ends Python where it is asked to do without.
OLD_EMITTERS = $(shell $(BIN)/python -c 'import jax; print("--xla_cpu_use_fusion_emitters=false" * (jax.__version_info__ < (0, 11)))')
# The longest test stands first, or one core would wait for it.
COMPILED_AS_FOR_USERS := tests/project/test_bundled_examples.py tests/project/test_sound_jax.py tests/interop \
	tests/brdf/plausibility/test_plausibility.py tests/fitting/solver tests/fitting/test_fit.py \
	tests/brdf/rendering/test_relighting.py tests/fitting/test_jpeg_errors.py tests/fitting/test_maximum_likelihood.py

.PHONY: fit test check docs lab wheel clean

fit: $(VENV)/installed
	$(BIN)/brdf fit $(EXAMPLE) --out out/gold-ball --plot

# As many tests run at a time as there are cores: matrix products that share all of these wait for each other.
test: export OPENBLAS_NUM_THREADS = 1
test: $(VENV)/installed-tests
	XLA_FLAGS="$(LIGHTLY_COMPILED)" $(BIN)/python -m pytest -n auto --dist worksteal $(COMPILED_AS_FOR_USERS:%=--ignore=%)
	$(BIN)/python -m pytest -n auto --dist worksteal $(COMPILED_AS_FOR_USERS)

check: $(VENV)/installed-tests
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --pythonpath $(BIN)/python

# One notebook at a time: kernels that start together may choose the same port, and one of them ends.
# What the notebooks measure of speed is true as users compile; who wants no more than to see it built says LIGHTLY=yes.
docs: export XLA_FLAGS := $(if $(LIGHTLY),$(LIGHTLY_COMPILED),$(XLA_FLAGS))
docs: $(VENV)/installed-docs
	$(BIN)/python -m sphinx --fail-on-warning --keep-going -q -b html -d out/docs-cache docs out/docs

# The wheel, built and used where nothing else of the project is: in an empty environment, outside of this folder. Four
# programs need byte code of a small part of it.
wheel: $(VENV)/installed
	rm -rf out/wheel && mkdir -p out/wheel
	$(BIN)/python -m pip wheel --quiet --disable-pip-version-check --no-deps -w out/wheel .
	$(PYTHON) -m venv out/wheel/venv
	out/wheel/venv/bin/python -m pip install --no-compile --quiet --disable-pip-version-check -c constraints.txt out/wheel/*.whl
	cd out/wheel && venv/bin/brdf fit ../../$(EXAMPLE) --model blinn-phong --out fit && venv/bin/brdf render fit -o again.exr
	cd out/wheel && venv/bin/python -c "import brdf, fitting; print(brdf.__version__, fitting.load_result('fit')['n'])"
	cd out/wheel && venv/bin/python -c "import sys, jax, numpy, fitting; print(sys.version, jax.__version__, numpy.__version__, \
		fitting.sensitivity(fitting.load_result('fit'), lambda scenes: [scenes[0].lights[0].direction])[0].n)"

lab: $(VENV)/installed-lab
	JUPYTER_CONFIG_PATH=$(CURDIR)/$(VENV)/lab $(BIN)/jupyter lab notebooks

$(VENV)/installed: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e .
	$(BIN)/python -m compileall -q brdf fitting  # as pip does of what it copies
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
