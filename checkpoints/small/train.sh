#!/usr/bin/env bash
# The shipped policy from nothing, on two CPU cores, measured at its end: see docs/training.md, "The small recipe".
#
#     checkpoints/small/train.sh [OUT]        (`make policy` sets everything up first)
#
# Both systems learn side by side. Half-way, and at its end, the hand plays episodes by itself, told the task's own
# subgoals, and PONDER then learns from those as well: the hand's misses are in no oracle's data. The same command goes on
# after a kill.
set -euo pipefail

out=${1:-out/small}
bin=${BIN:-.venv/bin}
export OMP_NUM_THREADS=1 MUJOCO_GL=${MUJOCO_GL:-egl}

finished() { [ -d "$out/run/ponder" ]; }
train() { finished || "$bin/pp-train" --recipe small --data "$out/data" --out "$out/run" "$@"; }
train_on_both_cores() {
    finished || "$bin/torchrun" --nproc-per-node=2 -m ponderpounce.training.train --recipe small --data "$out/data" \
        --out "$out/run" "$@"
}

hand() {  # lets the POUNCE of a stage play; what it does becomes the dataset $out/STAGE
    local stage=$1; shift
    "$bin/pp-eval" --tasks PickHighlight --runs 1 --cognition stand-in --pounce-checkpoint "$out/run/$stage/pounce" \
        --record --record-hz 5 --out "$out/played/$stage" "$@"
    if [ -d "$out/$stage/meta" ]; then return; fi
    local logs  # of finished episodes: a kill leaves the beginning of one more
    mapfile -t logs < <("$bin/python" -c 'import json, pathlib, sys
folder = pathlib.Path(sys.argv[1])
print(*(folder / each["mcap"] for each in json.loads((folder / "results.json").read_text())["episodes"]), sep="\n")' \
        "$out/played/$stage")
    "$bin/pp-export" "${logs[@]}" --out "$out/$stage"
}

[ -d "$out/data/meta" ] || "$bin/pp-collect" --tasks PickHighlight --episodes 600 --noise dart --recovery-share 0.4 \
    --frames training --invocation-hz 5 --out "$out/data"

train --stage looking --no-progress & looking=$!
train --stage reaching
wait $looking

train --stage motor --no-progress & motor=$!
hand reaching --episodes 200 --seed 1000000 --max-steps 800
train --stage grounding --watch "$out/reaching"
wait $motor

hand motor --episodes 150 --seed 1100000 --max-steps 700 --stand-in-noise-px 3
for stage in watching joint; do
    train_on_both_cores --stage $stage --watch "$out/reaching" "$out/motor"
done

"$bin/pp-eval" --tasks PickHighlight --episodes 60 --runs 1 --seed 1000 \
    --ponder-checkpoint "$out/run/ponder" --pounce-checkpoint "$out/run/pounce" --out "$out/real"
