# make setup   virtual environment, pinned dependencies, compiled extension
# make demo    train, bake and evaluate the sample scene (or DATA=folder or video) into demo/
# make test    the test suite, by WORKERS processes (as many as there are processors, at most 8)
# make bench   quality, speed, size and stability on the demo scene and on your captures, with a report (hours; training
#              and baking resume): make bench DATA="folder folder ..." [STEPS=1200] [SEEDS="0 1"]
#              [METHODS="bitymi bitymi-quality"] [PLANS="atlas overdraw"]
# make sanitize  the kernels' tests under the address and undefined-behaviour sanitizers (minutes)
# make clang-test  the same tests with the CPU kernels as Clang compiles them (CLANG=clang++)
# make baseline-test  the same tests with the CPU kernels for any CPU of this kind: on x86-64 without AVX
# make wheel-test  builds the wheel, without CUDA, looks into it and runs tests against it in an environment of its own
# make test-environment  installs the wheel beside the oldest and the newest packages, runs tests and commands there, and
#              records the versions (8 GB and half an hour each); ENDS=oldest or newest: one of them; DATA=capture
# make wheel   builds a wheel in dist/; with CUDA=1 one that has the kernels for GPUs of compute capability 7.5 to 12.0
#              (ARCHITECTURES) and needs nvcc here, not where it is installed
# make gate    trains, bakes and draws a fixed small scene and compares quality, bytes, memory and time with the
#              committed baseline, benchmarks/gate.json; make gate-accept renews the baseline
# make web     builds the viewer's page from web/ into bitymi_ns/view/page, which is committed: users need no Node.js
# make web-test  checks and tests of the page's sources, and that the committed page is what they give; says that it is
#              skipped where there is no Node.js. `make test` begins with it
# make lint    ruff, basedpyright (types) and clang-format
# Every step leaves a stamp in .venv and is skipped when nothing it depends on has changed.

PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
PIP    := $(BIN)/python -m pip --disable-pip-version-check
DATA   ?=
STEPS  ?=
SEEDS  ?=
METHODS ?= bitymi bitymi-quality
PLANS  ?= atlas overdraw
WORK   ?= outputs/bench
CLANG  ?= clang++
WORKERS ?= $(shell n=$$(nproc 2>/dev/null || echo 1); echo $$((n < 8 ? n : 8)))
TESTS  ?= tests/ops tests/stress tests/scene
ENDS   ?= oldest newest
CUDA   ?=
ARCHITECTURES ?= 75;80;86;89;90;100;120

TORCH       := torch==2.13.0
TORCHVISION := torchvision==0.28.0
CPU_INDEX   := https://download.pytorch.org/whl/cpu
CXX_FILES   := $(shell find csrc -name '*.cpp' -o -name '*.h' -o -name '*.cu')
# The CUDA kernels are built where nvcc is found: for the GPUs of this machine, for one architecture where there is no
# GPU and they can only be compiled. They are also built for the host, so that the tests run them without a GPU.
DEFINE      := --config-settings=cmake.define
CMAKE_ARGS  := $(DEFINE).BITYMI_EMULATED_CUDA=ON \
  $(if $(shell command -v nvidia-smi),,$(DEFINE).BITYMI_CUDA_ARCHITECTURES=90)

export OMP_NUM_THREADS ?= $(shell nproc 2>/dev/null || echo 1)

.PHONY: setup demo test test-all gate gate-accept wheel wheel-test test-environment sanitize clang-test baseline-test bench web web-test web-test-here lint format clean
.DELETE_ON_ERROR:

setup: $(VENV)/.stamp-build

$(VENV)/.stamp-venv:
	@command -v $(PYTHON) >/dev/null || { \
	  echo "No '$(PYTHON)' found. Install Python 3.10, 3.11 or 3.12, or run: make PYTHON=/path/to/python" >&2; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 12))' || { \
	  echo "$$($(PYTHON) -V) is not supported: nerfstudio needs 3.10, 3.11 or 3.12. Run: make PYTHON=python3.11" >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { \
	  echo "This Python has no venv module (on Debian and Ubuntu: apt install python3-venv)" >&2; exit 1; }
	@command -v $${CXX:-c++} >/dev/null || { \
	  echo "No C++ compiler found (on Debian and Ubuntu: apt install g++)" >&2; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@touch $@

# torch first, so that nothing else chooses it. Without an NVIDIA GPU its CPU build is enough: a tenth of the size. It
# comes from PyTorch's own index; where that cannot be reached, whatever the configured index has is taken.
$(VENV)/.stamp-torch: $(VENV)/.stamp-venv
	@if command -v nvidia-smi >/dev/null; then \
	  $(PIP) install -qq $(TORCH) $(TORCHVISION); \
	else \
	  $(PIP) install -qq --retries 0 --timeout 5 --extra-index-url $(CPU_INDEX) $(TORCH)+cpu $(TORCHVISION)+cpu \
	    2>/dev/null \
	  || { echo "No CPU wheels of torch and torchvision from $(CPU_INDEX): taking the default ones"; \
	       $(PIP) install -qq $(TORCH) && $(PIP) install -qq --no-deps $(TORCHVISION); }; \
	fi
	@touch $@

$(VENV)/.stamp-deps: $(VENV)/.stamp-torch constraints.txt pyproject.toml scripts/torchvision_remedy.py
	@echo "Installing nerfstudio and what it needs (a few minutes the first time)"
	@$(PIP) install -qq -c constraints.txt nerfstudio==1.1.5 scikit-build-core nanobind cmake ninja \
	  $$($(BIN)/python scripts/requirements.py)
	$(BIN)/python scripts/torchvision_remedy.py
	@$(BIN)/python -c 'import open3d' || { \
	  echo "open3d, which nerfstudio reads point clouds with, lacks a library of the system (last line above)." >&2; \
	  echo "On Debian and Ubuntu: apt install libgl1 libegl1 libx11-6 libudev1 libusb-1.0-0 libidn2-0 libgomp1" >&2; exit 1; }
	@touch $@

# Editable: changes to Python are live, changes to C++ need another make (seconds: build/ is kept).
$(VENV)/.stamp-build: $(VENV)/.stamp-deps CMakeLists.txt $(wildcard cmake/*.cmake) $(CXX_FILES)
	$(PIP) install -qq --no-build-isolation --no-deps $(CMAKE_ARGS) -e .
	@touch $@

demo: setup
	PATH="$(CURDIR)/$(BIN):$$PATH" bash scripts/demo.sh $(if $(DATA),"$(DATA)")

# A worker of pytest per processor, each with one thread: files of tests beside each other, the slow ones first. Fixtures
# of a file are made once, as it stays with one worker. Tests of threads set their number themselves. Rewritten tests
# and the package are compiled once, not by every process that tests start, hence bytecode is written.
# test: every module in minutes; test-all: the rest, which tests marked slow are.
test: setup web-test
test-all: setup $(if $(shell command -v npm),web/node_modules/.package-lock.json)
test test-all:
	BITYMI_TESTS_REQUIRE=emulated OMP_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -q --durations 20 \
	  -n $(WORKERS) --dist loadfile --no-loadscope-reorder -m $(if $(filter test,$@),'not slow',slow)

# npm records in node_modules what it installed from which lock file.
web/node_modules/.package-lock.json: web/package-lock.json
	cd web && npm ci --loglevel=error --no-fund --no-audit
	@touch $@

web: setup web/node_modules/.package-lock.json
	$(BIN)/python -m scripts.page_tables
	cd web && npm run --silent build

web-test:
	@if command -v npm >/dev/null; then $(MAKE) --no-print-directory web-test-here; \
	  else echo "web-test is skipped: no npm found (on Debian and Ubuntu: apt install nodejs npm)"; fi

web-test-here: web/node_modules/.package-lock.json
	cd web && npm run --silent check && npm run --silent test && npx --no vite build --logLevel error --outDir "$(CURDIR)/build/page"
	diff -r build/page bitymi_ns/view/page || { \
	  echo "bitymi_ns/view/page is not what web/ gives: run make web, and commit it" >&2; exit 1; }

gate gate-accept: setup
	$(BIN)/python benchmarks/gate.py $(if $(filter %-accept,$@),--accept)

wheel: $(VENV)/.stamp-deps
	$(PIP) wheel -q --no-build-isolation --no-deps -w dist $(DEFINE).BITYMI_CUDA=$(if $(CUDA),ON,OFF) \
	  $(if $(CUDA),'$(DEFINE).BITYMI_CUDA_ARCHITECTURES=$(ARCHITECTURES)') .
	@ls -l dist/*.whl

wheel-test: setup
	$(BIN)/python scripts/wheel_test.py

# A build of the CPU kernels in build/$(1) with CMake's options $(2), and their tests with it and the options $(3).
define test_build
$(BIN)/cmake -S . -B build/$(1) -G Ninja $(2) -DBITYMI_CUDA=OFF \
  -DPython_EXECUTABLE=$(CURDIR)/$(BIN)/python -DCMAKE_MAKE_PROGRAM=$(CURDIR)/$(BIN)/ninja >/dev/null
$(BIN)/cmake --build build/$(1)
$(BIN)/python scripts/test_build.py $(3) build/$(1) $(TESTS)
endef

test-environment:
	$(PYTHON) scripts/test_environment.py $(addprefix --end ,$(ENDS)) --work outputs/environments $(if $(DATA),--data "$(DATA)")

sanitize: setup
	$(call test_build,sanitize,-DBITYMI_SANITIZE=ON,--sanitizers)

clang-test: setup
	@command -v $(CLANG) >/dev/null || { \
	  echo "No '$(CLANG)' found (on Debian and Ubuntu: apt install clang libomp-dev). Another: make $@ CLANG=..." >&2; exit 1; }
	$(call test_build,clang,-DCMAKE_CXX_COMPILER=$(CLANG),)

baseline-test: setup
	$(call test_build,baseline,-DBITYMI_MARCH=default,)

$(WORK)/captures/demo/transforms.json: | setup
	$(BIN)/bitymi sample --output-dir $(@D)

MATRIX = $(BIN)/bitymi bench local --data $(WORK)/captures/demo $(DATA) --work $(WORK) \
  $(if $(STEPS),--steps $(STEPS)) $(if $(SEEDS),--seeds $(SEEDS))

bench: setup $(WORK)/captures/demo/transforms.json
	@failed=0; trap 'exit 130' INT; set -x; \
	$(MATRIX) --methods $(METHODS) --output $(WORK)/captures.md || failed=1; \
	for plan in $(PLANS); do $(MATRIX) --plan $$plan --output $(WORK)/$$plan.md || failed=1; done; \
	$(BIN)/bitymi stability --output $(WORK)/stability.md || failed=1; \
	$(BIN)/bitymi report $(WORK) --output-dir $(WORK)/report --title "bitymi bench" || failed=1; \
	exit $$failed

lint: $(VENV)/.stamp-deps
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/basedpyright
	$(BIN)/clang-format --dry-run -Werror $(CXX_FILES)

format: $(VENV)/.stamp-deps
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .
	$(BIN)/clang-format -i $(CXX_FILES)

clean:
	rm -rf build demo .pytest_cache .ruff_cache .hypothesis
	rm -f $(VENV)/.stamp-build
