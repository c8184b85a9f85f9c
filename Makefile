# make run: set everything up, then train AIB on InterceptFast (a --quick trial where there is no CUDA device)
# make demo: set everything up, then train AIB on RememberColor3 with --small, and draw its curve
# make test: set everything up, then lint and run the tests
# make test-all: all tests, with every kill of every stage, diagnose_agent.py and three seeds of learning
# make test-gpu: the three PPO scripts' --quick on a GPU, with physics there and then on the CPU
# make bench: speed, as ratios measured in one run
SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
.ONESHELL:
.SILENT:
.PHONY: run demo test test-all test-gpu bench setup vulkan

PYTHON ?= python3
PY := .venv/bin/python

run: setup
	quick=$$($(PY) -c "import torch; print('' if torch.cuda.is_available() else '--quick')")
	$(PY) ppo_aib.py --env-id InterceptFast-v0 $$quick

demo: setup
	task="--env-id RememberColor3-v0 --small"
	echo "AIB on RememberColor3-v0 in three stages, less than an hour; stopped, make demo resumes it"
	echo "stage 1 of 3: 640 random episodes and the state encoder phi, about 6 minutes"
	$(PY) aib_repr.py $$task --num-episodes 640 --exp-name aib_repr_demo
	echo "stage 2 of 3: the belief, about 20 minutes"
	$(PY) aib_belief.py $$task --repr-dir runs/RememberColor3-v0__aib_repr_demo__1 --exp-name aib_belief_demo
	echo "stage 3 of 3: PPO on observation and belief, about 30 minutes; curves: .venv/bin/tensorboard --logdir runs"
	$(PY) ppo_aib.py $$task --belief runs/RememberColor3-v0__aib_belief_demo__1/belief.pt --exp-name ppo_aib_demo --total-timesteps 120000
	$(PY) benchmark/report.py --runs runs
	echo "chance level of success_once: 0.33; plain PPO stays there"
	echo "curve: benchmark/report/learning_curves.png; videos: runs/RememberColor3-v0__ppo_aib_demo__1/videos"

test: setup
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(PY) -m pytest --numprocesses auto --dist loadfile -m "not thorough"

test-all: setup
	$(PY) -m pytest --numprocesses auto --dist loadfile

test-gpu: setup
	$(PY) -c "import sys, torch; sys.exit(not torch.cuda.is_available())" || { echo "error: torch sees no CUDA device here" >&2; exit 2; }
	root=$$PWD
	for backend in physx_cuda physx_cpu; do
	    cd "$$(mktemp -d)"
	    for script in ppo_aib ppo_believer ppo_baseline; do
	        $$root/$(PY) $$root/$$script.py --env-id InterceptFast-v0 --quick --sim-backend $$backend
	    done
	done

bench: setup
	$(PY) benchmark/speed.py

setup: .venv/installed vulkan

.venv/installed: requirements.txt Makefile
	version=$$($(PYTHON) -c "import sys; print('%d.%d' % sys.version_info[:2])")
	if [ "$$version" != 3.11 ] && [ "$$version" != 3.12 ]; then
	    echo "error: $(PYTHON) is Python $$version, and the simulator has packages for 3.11 and 3.12 only; install one of" \
	        "them and name it: make PYTHON=python3.11" >&2
	    exit 2
	fi
	if ! [ -x .venv/bin/python$$version ]; then  # none yet, or one of another Python
	    $(PYTHON) -m venv --clear .venv || { echo "error: $(PYTHON) cannot make a virtual environment; install python3-venv" >&2; exit 2; }
	fi
	$(PY) -m pip install --requirement requirements.txt
	$(PY) -m pip install --no-deps --ignore-requires-python mikasa-robo-suite==1.0.0
	$(PY) -m pip uninstall --yes opencv-python  # ManiSkill's choice needs libGL.so.1, which servers lack
	$(PY) -m pip install --force-reinstall --no-deps opencv-python-headless
	# SAPIEN makes a table for reflections of a sky at each start, most of the start on a CPU; these tasks have no sky
	shaders=$$($(PY) -c "import sapien; print(sapien.__path__[0] + '/vulkan_shader/minimal')")
	sed -i -e '/sampler2D samplerBRDFLUT;/d' -e 's/texture(samplerBRDFLUT, vec2(roughness, dotNV)).xy/vec2(1, 0)/' "$$shaders"/*.frag
	! grep -q samplerBRDFLUT "$$shaders"/*.frag || echo "warning: SAPIEN's shaders are not those that were expected; it starts slowly" >&2
	touch .venv/installed

# Rendering needs a Vulkan driver. Where neither a GPU's nor another one works, install Mesa's CPU driver, 24.3 or newer.
vulkan: .venv/installed
	renders() { $(PY) -c "import sapien; sapien.render.RenderSystem(sapien.Device('$$1'))" >/dev/null 2>&1; }
	if renders cuda || renders cpu; then exit 0; fi
	if ! command -v apt-get >/dev/null; then
	    echo "error: no Vulkan driver that SAPIEN can use; install Mesa's Vulkan drivers, 24.3 or newer, then run make again" >&2
	    exit 2
	fi
	if [ "$$(id -u)" != 0 ]; then
	    echo "error: no Vulkan driver that SAPIEN can use; install one with: sudo make vulkan (it adds your Debian's or" \
	        "Ubuntu's mesa-vulkan-drivers, libvulkan1 and libx11-6, from backports where the release is too old)" >&2
	    exit 2
	fi
	export DEBIAN_FRONTEND=noninteractive
	. /etc/os-release
	echo "no Vulkan driver that SAPIEN can use: installing mesa-vulkan-drivers (24.3 or newer), libvulkan1 and libx11-6" \
	    "with apt-get from $$PRETTY_NAME, or from its backports where those are too old"
	apt-get update
	candidate=$$(apt-cache policy mesa-vulkan-drivers | awk '/Candidate:/ { print $$2 }')
	release=
	if dpkg --compare-versions "$$candidate" lt 24.3; then
	    release=$$VERSION_CODENAME-backports
	    # the machine's own entry for its release, with the suite changed, so that its mirror stays its mirror
	    if [ -e /etc/apt/sources.list.d/debian.sources ]; then
	        awk -v suite="$$VERSION_CODENAME" -v new="$$release" 'BEGIN { RS = ""; ORS = "\n\n" }
	            $$0 ~ "(^|\n)Suites:([^\n]*[ \t])?" suite "([ \t\n]|$$)" { sub(/Suites:[^\n]*/, "Suites: " new); print; exit }' \
	            /etc/apt/sources.list.d/debian.sources | tee /etc/apt/sources.list.d/$$release.sources
	    else
	        awk -v suite="$$VERSION_CODENAME" -v new="$$release" \
	            '$$1 == "deb" { for (i = 2; i <= NF; i++) if ($$i == suite) { $$i = new; print; exit } }' \
	            /etc/apt/sources.list | tee /etc/apt/sources.list.d/$$release.list
	    fi
	    apt-get update
	fi
	apt-get install --yes --no-install-recommends $${release:+--target-release $$release} mesa-vulkan-drivers libvulkan1 libx11-6
	renders cpu || { echo "error: the Vulkan driver is installed, and SAPIEN still cannot render; see docs/experiments.md" >&2; exit 2; }
