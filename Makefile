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

# `make help` lists the rest.
.PHONY: help setup demo policy test unit accept lint types proto bench clean
help:
	@sed -n 's/^## //p' $(MAKEFILE_LIST)

## make setup   create .venv and install the pinned packages (the others call it when needed)
setup: $(READY)

$(READY): requirements.txt pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "Python 3.11 or newer is needed; set PYTHON=python3.11"; exit 1; }
	@$(PYTHON) -c 'import venv, ensurepip' || { echo "The venv module is missing: apt-get install python3-venv"; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet "$(TORCH)"           # first and alone: a range elsewhere would fetch gigabytes of CUDA
	$(BIN)/pip install --quiet -r requirements.txt
	$(BIN)/pip install --quiet --no-deps robosuite==1.5.2 openpi-client==0.1.2  # their own pins contradict numpy 2
	# A CUDA build of torch brings its own Triton, and elsewhere than on Linux there is none.
	$(BIN)/python -c 'import triton' 2>/dev/null || test "$$(uname)" != Linux || $(BIN)/pip install --quiet triton==3.6.0
	$(BIN)/pip install --quiet --no-deps --no-build-isolation --editable .
	touch $@

## make demo    three processes drive a Panda through PickHighlight; logs, checks and a picture in out/demo
SHIPPED := --ponder-checkpoint checkpoints/small/ponder --pounce-checkpoint checkpoints/small/pounce

demo: setup
	$(BIN)/pp-doctor --required-only
	rm -rf out/demo
	@echo "--- real time: ponder-serve, pounce-serve and clock-serve over zenoh, with the small policy that was trained here"
	$(BIN)/sim-client --local --mode realtime $(SHIPPED) --difficulty easy --episodes 1 --max-steps 400 --out out/demo/realtime
	@echo "--- lockstep: the paper's schedule, both models at 1 Hz, 300 ms of delay"
	$(BIN)/sim-client --local --mode lockstep $(SHIPPED) --difficulty easy --episodes 2 --max-steps 400 --out out/demo/lockstep
	@echo "--- does it remember? the same scenes with its cognition, and with the learned null in its place"
	$(BIN)/pp-eval $(SHIPPED) --tasks PickHighlight --difficulty easy --episodes 6 --runs 1 --max-steps 600 --out out/demo/real
	$(BIN)/pp-eval $(SHIPPED) --tasks PickHighlight --difficulty easy --episodes 6 --runs 1 --max-steps 600 --cognition null --out out/demo/null
	@echo "--- the task's own script, to see the task done"
	$(BIN)/sim-client --policy oracle --episodes 3 --out out/demo/oracle
	@echo "--- every reference, age, row and deadline again, from the logs alone"
	$(BIN)/pp-check $$(find out/demo -name '*.mcap')
	$(BIN)/pp-replay $$(find out/demo/realtime -name '*.mcap') --save out/demo/realtime.rrd
	@echo "Watch one: $(BIN)/pp-replay $$(find out/demo/lockstep -name '*.mcap' | head -1)"

## make policy  train the demo's policy again from nothing, on two cores, and measure it; goes on after a kill
policy: setup
	BIN=$(BIN) checkpoints/small/train.sh out/small
	BIN=$(BIN) checkpoints/small/follow.sh out/small

## make test    everything that needs no GPU; make unit: without processes and long runs
# Files share the cores; a test that starts processes of its own has them all.
test: setup
	$(BIN)/python -m pytest -q -n $(JOBS) --dist loadfile -m "not gpu and not acceptance and not e2e" --durations=10
	$(BIN)/python -m pytest -q -m "e2e and not gpu and not acceptance" --durations=10
unit: setup
	$(BIN)/python -m pytest -q -n $(JOBS) --dist loadfile -m "not gpu and not acceptance and not e2e and not slow"

## make accept  a hundred oracle episodes of every task (about ten minutes)
accept: setup
	$(BIN)/python -m pytest -q -m acceptance

## make lint    style, types, import contracts, generated code up to date
lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

## make proto   regenerate the protobuf modules (commit the result)
proto: setup
	$(BIN)/python -m grpc_tools.protoc -I . --python_out=. --pyi_out=. $(PB)/common.proto $(PB)/stream.proto $(PB)/episode.proto

## make bench   every benchmark, then the tables (about ten minutes on a quiet machine)
bench: setup
	$(BIN)/python -m benchmarks.bus_latency
	$(BIN)/python -m benchmarks.ponder_latency
	$(BIN)/python -m benchmarks.ponder_concurrency
	$(BIN)/python -m benchmarks.training_throughput
	$(BIN)/python -m benchmarks.training_update
	$(BIN)/python -m benchmarks.playback_jitter
	$(BIN)/python -m benchmarks.episode_throughput
	$(BIN)/python -m benchmarks.fault_drill
	$(BIN)/python -m benchmarks.render

clean:
	rm -rf out build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
