# Two commands do everything on a fresh machine: `make demo` and `make test`. Plain pip; nothing outside .venv and out/.
VENV ?= .venv
PYTHON ?= python3
# A CPU build is enough for the demo and the tests. On a machine with its own build, say TORCH=torch or TORCH=path.whl.
TORCH ?= torch==2.13.0
BIN := $(VENV)/bin
READY := $(VENV)/.ready
PB := protocol/ponderpounce/v1
JOBS ?= $(shell getconf _NPROCESSORS_ONLN)
export MUJOCO_GL ?= egl
export OMP_NUM_THREADS ?= 1
# Where it is set, every process that a test starts compiles our modules again (half a second each).
unexport PYTHONDONTWRITEBYTECODE

# `make help` lists the rest.
.PHONY: help setup demo test unit oldest peers wheels accept soak images policy kitchen site lint types proto bench clean
help:
	@sed -n 's/^## //p' $(MAKEFILE_LIST)

## make setup   create .venv and install the pinned packages (the others call it when needed)
setup: $(READY)

# pip compiles one file after another, which takes longer than to fetch them; at the end all cores do it at once.
INSTALL := $(BIN)/pip install --quiet --no-compile

$(READY): requirements.txt pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "Python 3.11 or newer is needed; set PYTHON=python3.11"; exit 1; }
	@$(PYTHON) -c 'import venv, ensurepip' || { echo "The venv module is missing: apt-get install python3-venv"; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(INSTALL) "$(TORCH)"           # first and alone: a range elsewhere would fetch gigabytes of CUDA
	$(INSTALL) -r requirements.txt
	$(INSTALL) --no-deps robosuite==1.5.2 openpi-client==0.1.2  # their own pins contradict numpy 2
	# A CUDA build of torch brings its own Triton, and elsewhere than on Linux there is none.
	$(BIN)/python -c 'import triton' 2>/dev/null || test "$$(uname)" != Linux || $(INSTALL) triton==3.6.0
	$(INSTALL) --no-deps --no-build-isolation --editable .
	@$(BIN)/python -m compileall -q -j 0 $(VENV)/lib >/dev/null || true  # some files are of a newer Python
	touch $@

## make demo    a trained pair drives a Panda through PickHighlight, with memory and without; everything is in out/demo
PAIR := --ponder-checkpoint checkpoints/small/ponder --pounce-checkpoint checkpoints/small/pounce
SCENES := --tasks PickHighlight --difficulty easy --episodes 6 --runs 1 --max-steps 600

demo: setup
	$(BIN)/pp-doctor --required-only
	rm -rf out/demo
	@echo "--- real time: ponder-serve, pounce-serve and clock-serve over zenoh"
	$(BIN)/sim-client --local --mode realtime $(PAIR) --difficulty easy --max-steps 400 --out out/demo/realtime
	@echo "--- lockstep: the paper's schedule, both models at 1 Hz, PONDER 300 ms late"
	$(BIN)/sim-client --local $(PAIR) --difficulty easy --episodes 2 --max-steps 400 --out out/demo/lockstep
	@echo "--- six scenes with PONDER's cognition, and the same six with the learned null in its place"
	$(BIN)/pp-eval $(PAIR) $(SCENES) --out out/demo/real
	$(BIN)/pp-eval $(PAIR) $(SCENES) --cognition null --out out/demo/null
	@echo "--- every reference, age, row and deadline again, from the logs alone"
	$(BIN)/pp-check $$(find out/demo -name '*.mcap')
	$(BIN)/pp-replay $$(find out/demo/realtime -name '*.mcap') --save out/demo/realtime.rrd
	@echo "---------------------------------------------------------------------------"
	@$(BIN)/python examples/05_worth_of_memory.py out/demo/real out/demo/null
	@echo "                (this pair's POUNCE has no camera: its null is blind as well; see README.md)"
	@echo "logs            all $$(find out/demo -name '*.mcap' | wc -l) agree with the schedule"
	@echo "to watch one    $(BIN)/pp-replay $$(find out/demo/realtime -name '*.mcap')"

## make test    the tests that need no GPU, but those of make accept; make unit: without processes and long runs
# Files share the cores; a test that keeps real time has them all.
test: setup
	$(BIN)/python -m pytest -q -n $(JOBS) --dist loadfile -m "not gpu and not acceptance and not peers and not realtime" --durations=10
	$(BIN)/python -m pytest -q $$(grep -rl --include='*.py' 'mark\.realtime' tests) -m "realtime and not gpu and not acceptance and not peers" --durations=10
unit: setup
	$(BIN)/python -m pytest -q -n $(JOBS) --dist loadfile -m "not gpu and not acceptance and not peers and not e2e and not slow"

## make oldest  the models' tests under the oldest transformers that pyproject.toml allows
OLDEST := $(VENV)/oldest
oldest: setup
	test -d $(OLDEST)/transformers || $(BIN)/pip install --quiet --no-deps --target $(OLDEST) transformers==5.17.0
	test -d $(OLDEST)/httpx || $(BIN)/pip install --quiet --target $(OLDEST) 'huggingface-hub<2' httpx
	PYTHONPATH=$(OLDEST) $(BIN)/python -m pytest -q -n $(JOBS) --dist loadfile -m "not gpu" tests/models tests/ponder_server

## make peers   unit under Python 3.12 and 3.13; LeRobot, rosbags, Foxglove's reader and Grafana's SDK beside us; writes benchmarks/reports/peers.json (an hour)
LEROBOT := $(VENV)/peers/lerobot
$(LEROBOT)/.ready:
	python3.12 -m venv $(LEROBOT)
	$(LEROBOT)/bin/pip install --quiet "$(TORCH)" torchvision
	$(LEROBOT)/bin/pip install --quiet --no-deps lerobot==0.6.1  # its own pin of torch would fetch CUDA
	$(LEROBOT)/bin/pip install --quiet 'datasets<5' 'pandas<3' 'av<16' 'draccus>=0.11.6,<0.12' 'huggingface-hub<2' jsonlines einops \
		safetensors gymnasium opencv-python-headless msgpack websockets termcolor deepdiff requests 'setuptools<82'
	touch $@
ROSBAGS := $(VENV)/peers/rosbags
$(ROSBAGS)/.ready:
	$(PYTHON) -m venv $(ROSBAGS)
	$(ROSBAGS)/bin/pip install --quiet rosbags==0.11.9 pillow
	touch $@
FOXGLOVE := $(VENV)/peers/foxglove
$(FOXGLOVE)/.ready:
	mkdir -p $(FOXGLOVE)
	if command -v npm; then npm install --silent --prefix $(FOXGLOVE) @mcap/core@2.2.2 @mcap/nodejs@1.0.2 @mcap/support@1.1.0; fi
	touch $@
GRAFANA := $(VENV)/peers/grafana
$(GRAFANA)/.ready:
	$(BIN)/pip install --quiet --no-deps --target $(GRAFANA) grafana-foundation-sdk
	touch $@
peers: setup site $(LEROBOT)/.ready $(ROSBAGS)/.ready $(FOXGLOVE)/.ready $(GRAFANA)/.ready
	for version in 3.12 3.13; do $(MAKE) setup VENV=$(VENV)/peers/$$version PYTHON=python$$version || exit 1; done
	PYTHONPATH=$(GRAFANA) $(BIN)/python -m benchmarks.peers --jobs $(JOBS) --pythons $(VENV)/peers/3.12/bin/python $(VENV)/peers/3.13/bin/python \
		--lerobot $(LEROBOT)/bin/python --rosbags $(ROSBAGS)/bin/python \
		$$(test -d $(FOXGLOVE)/node_modules && echo --foxglove $(FOXGLOVE)/node_modules)
	$(BIN)/python -m benchmarks.render

## make wheels  every extra from the built wheel in an environment of its own (python3.11 to 3.13; an hour)
wheels: setup
	$(BIN)/python -m benchmarks.wheels

## make accept  a hundred oracle episodes of every task, longer journeys, and what repeats laws of make test at more sizes
accept: setup
	$(BIN)/python -m pytest -q -m acceptance

## make soak    a million mutated messages, in lockstep and in real time (about half an hour)
soak: setup
	$(BIN)/python -m benchmarks.fuzz

## make images  builds the four container images and plays an episode with them (root, buildah)
images: setup
	$(BIN)/python -m benchmarks.images

## make policy  trains the laptop pair, a slice of MINUTES at a time; keeps data and checkpoints in POLICY_DIR, outside of here; TASKS="A B": of these tasks alone
MINUTES ?= 150
POLICY_DIR ?= $(HOME)/ponderpounce-policy
policy: setup
	$(BIN)/python -m benchmarks.policy --folder "$(POLICY_DIR)" --minutes $(MINUTES) $(if $(TASKS),--tasks $(TASKS))

## make kitchen trains and plays RoboCasa-DC's experiment at laptop size, likewise, in KITCHEN_DIR
KITCHEN_DIR ?= $(HOME)/ponderpounce-kitchen
kitchen: setup
	$(BIN)/python -m benchmarks.kitchen_policy --folder "$(KITCHEN_DIR)" --minutes $(MINUTES)

## make site    the documents as a site, links checked, in out/site/html
SITE := $(VENV)/site
$(SITE)/.ready: site/requirements.txt
	$(PYTHON) -m venv $(SITE)
	$(SITE)/bin/pip install --quiet -r site/requirements.txt
	touch $@
site: $(SITE)/.ready
	rm -rf out/site
	mkdir -p out/site/pages
	git ls-files --cached --others --exclude-standard -- '*.md' 'docs/*' 'examples/*' 'docker/*' '*.py' '*.png' 'site/*.css' | grep -v '^tests/.*\.md' | xargs cp --parents -t out/site/pages
	$(SITE)/bin/mkdocs build --quiet --strict --config-file site/mkdocs.yaml

## make lint    style, types, import contracts
lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

## make proto   regenerate the protobuf modules (commit the result)
proto: setup
	$(BIN)/python -m grpc_tools.protoc -I . --python_out=. --pyi_out=. $(PB)/common.proto $(PB)/stream.proto $(PB)/episode.proto

## make bench   most benchmarks, then the tables (about forty minutes on two cores)
bench: setup
	$(BIN)/python -m benchmarks.bus_latency
	$(BIN)/python -m benchmarks.ponder_latency
	$(BIN)/python -m benchmarks.ponder_concurrency
	$(BIN)/python -m benchmarks.training_throughput
	$(BIN)/python -m benchmarks.playback_jitter
	$(BIN)/python -m benchmarks.episode_throughput
	$(BIN)/python -m benchmarks.fault_drill
	$(BIN)/python -m benchmarks.render

clean:
	rm -rf out build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
