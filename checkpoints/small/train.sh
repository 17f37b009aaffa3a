#!/usr/bin/env bash
# The shipped policy from nothing, on two CPU cores, measured at its end: see docs/training.md, "The small recipe".
#
#     checkpoints/small/train.sh [OUT]        (`make policy` sets everything up first)
#
# Both systems learn side by side. Half-way the hand plays episodes by itself, told the task's own subgoals, and PONDER
# then learns from those as well: the hand's misses are in no oracle's data. The same command goes on after a kill.
set -euo pipefail

out=${1:-out/small}
bin=${BIN:-.venv/bin}
export OMP_NUM_THREADS=1 MUJOCO_GL=${MUJOCO_GL:-egl}

train() { [ -d "$out/run/ponder" ] || "$bin/pp-train" --recipe small --data "$out/data" --out "$out/run" "$@"; }

[ -d "$out/data/meta" ] || "$bin/pp-collect" --tasks PickHighlight --episodes 600 --noise dart --recovery-share 0.4 \
    --frames training --invocation-hz 5 --out "$out/data"

train --stage looking --no-progress & looking=$!
train --stage reaching
wait $looking

train --stage motor --no-progress & motor=$!
"$bin/pp-eval" --tasks PickHighlight --episodes 200 --runs 1 --seed 1000000 --cognition stand-in --max-steps 800 \
    --pounce-checkpoint "$out/run/reaching/pounce" --record --record-hz 5 --out "$out/hand"
[ -d "$out/watched/meta" ] || "$bin/pp-export" "$out"/hand/*/PickHighlight/*.mcap --out "$out/watched"
train --stage grounding --watch "$out/watched"
wait $motor

train --watch "$out/watched"  # what is left: both together

"$bin/pp-eval" --tasks PickHighlight --episodes 60 --runs 1 --seed 1000 \
    --ponder-checkpoint "$out/run/ponder" --pounce-checkpoint "$out/run/pounce" --out "$out/real"
