#!/usr/bin/env bash
# The shipped policy from nothing, on two CPU cores, measured at its end: see docs/training.md, "The small recipe".
#
#     checkpoints/small/train.sh [OUT]        (`make policy` sets everything up first)
#
# PONDER's eyes are opened first. Then both systems learn side by side. Half-way, and at its end, the hand plays episodes by
# itself, told the task's own subgoals, and PONDER learns from those as well: the hand's misses are in no oracle's data. The
# same command goes on after a kill.
set -euo pipefail

out=${1:-out/small}
bin=${BIN:-.venv/bin}
export OMP_NUM_THREADS=1 MUJOCO_GL=${MUJOCO_GL:-egl}

finished() { [ -d "$out/run/ponder" ]; }
how=(--recipe small --data "$out/data" --out "$out/run" --ponder "$out/eyes/ponder" --sights "$out/sights")
train() { finished || "$bin/pp-train" "${how[@]}" "$@"; }
train_on_both_cores() { finished || "$bin/torchrun" --nproc-per-node=2 -m ponderpounce.training.train "${how[@]}" "$@"; }

hand() {  # lets the POUNCE of a stage play; what it does becomes the dataset $out/NAME
    local name=$1 stage=$2; shift 2
    "$bin/pp-eval" --tasks PickHighlight --runs 1 --cognition stand-in --order near-first \
        --pounce-checkpoint "$out/run/$stage/pounce" --record --record-hz 5 --out "$out/played/$name" "$@"
    if [ -d "$out/$name/meta" ]; then return; fi
    local logs  # of finished episodes: a kill leaves the beginning of one more
    mapfile -t logs < <("$bin/python" -c 'import json, pathlib, sys
folder = pathlib.Path(sys.argv[1])
print(*(folder / each["mcap"] for each in json.loads((folder / "results.json").read_text())["episodes"]), sep="\n")' \
        "$out/played/$name")
    "$bin/pp-export" "${logs[@]}" --out "$out/$name"
}

[ -d "$out/data/meta" ] || "$bin/pp-collect" --tasks PickHighlight --episodes 600 --noise dart --recovery-share 0.4 \
    --frames training --invocation-hz 5 --difficulties easy medium hard --order near-first --out "$out/data"

[ -d "$out/album/meta" ] || "$bin/pp-album" --pictures 10000 --out "$out/album"
[ -d "$out/eyes/ponder" ] || OMP_NUM_THREADS=2 "$bin/pp-see" --recipe small --data "$out/data" --album "$out/album" --out "$out/eyes"

train --stage looking --no-progress & looking=$!
train --stage reaching
hand reaching reaching --episodes 200 --seed 1000000 --max-steps 800 & playing=$!
train --stage motor --no-progress
wait $looking $playing

hand motor motor --episodes 150 --seed 1100000 --max-steps 700 --stand-in-noise-px 3
hand longer motor --episodes 240 --seed 1200000 --max-steps 900 --stand-in-noise-px 3
for stage in grounding refining joint; do
    train_on_both_cores --stage $stage --watch "$out/reaching" "$out/motor" "$out/longer"
done

"$bin/pp-eval" --tasks PickHighlight --episodes 60 --runs 1 --seed 1000 \
    --ponder-checkpoint "$out/run/ponder" --pounce-checkpoint "$out/run/pounce" --out "$out/real"
