#!/usr/bin/env bash
# A pair from nothing, on two CPU cores, measured at its end: see docs/training.md, "The small recipe". follow.sh goes on from it to
# the shipped policy.
#
#     checkpoints/small/train.sh [OUT]        (`make policy` sets everything up first)
#
# PONDER's eyes are opened first. Then both systems learn side by side. Half-way, and at its end, the hand plays episodes by
# itself, told the task's own subgoals, and PONDER learns from those as well: the hand's misses are in no oracle's data. Then
# the pair plays, the oracle takes its episodes over (pp-correct), and both learn from that. The same command goes on after
# a kill.
set -euo pipefail

out=${1:-out/small}
bin=${BIN:-.venv/bin}
source "$(dirname "$0")/common.sh"
export OMP_NUM_THREADS=1 MUJOCO_GL=${MUJOCO_GL:-egl}

finished() { [ -d "$out/run/ponder" ]; }
how=(--recipe small --out "$out/run" --ponder "$out/eyes/ponder" --sights "$out/sights")
oracle=(--data "$out/data")
train() { finished || "$bin/pp-train" "${how[@]}" "$@"; }
train_on_both_cores() {
    finished || "$bin/torchrun" --nproc-per-node=2 -m dual_system.training.train --weights whole "${how[@]}" "$@"
}

play() {  # records episodes of $out/played/NAME
    local name=$1; shift
    "$bin/pp-eval" --tasks PickHighlight --runs 1 --order near-first --record --record-hz 5 --out "$out/played/$name" "$@"
}

hand() {  # lets the POUNCE of a stage play, told the task's own subgoals
    local name=$1 stage=$2; shift 2
    play "$name" --cognition stand-in --pounce-checkpoint "$out/run/$stage/pounce" "$@"
}

export_played() {  # makes a dataset of them
    local found
    mapfile -t found < <(logs "$out/played/$1")
    [ -d "$out/$1/meta" ] || "$bin/pp-export" "${found[@]}" --out "$out/$1"
}

mend() {  # those that got stuck often
    correct "$out/played/$1" SUCCESS 1 "$out/mended/$2"
    correct "$out/played/$1" TIMEOUT "$3" "$out/mended/$2-stuck"
}

[ -d "$out/data/meta" ] || "$bin/pp-collect" --tasks PickHighlight --episodes 600 --noise dart --recovery-share 0.4 \
    --frames training --invocation-hz 5 --difficulties easy medium hard --order near-first --out "$out/data"

[ -d "$out/album/meta" ] || "$bin/pp-album" --pictures 10000 --out "$out/album"
[ -d "$out/eyes/ponder" ] || OMP_NUM_THREADS=2 "$bin/pp-see" --recipe small --data "$out/data" --album "$out/album" --out "$out/eyes"

train "${oracle[@]}" --stage looking --no-progress & looking=$!
train "${oracle[@]}" --stage reaching
{ hand reaching reaching --episodes 200 --seed 1000000 --max-steps 800; export_played reaching; } & playing=$!
train "${oracle[@]}" --stage motor --no-progress
wait $looking $playing

hand motor motor --episodes 150 --seed 1100000 --max-steps 900 --stand-in-noise-px 3
hand longer motor --episodes 240 --seed 1200000 --max-steps 900 --stand-in-noise-px 3
export_played motor
export_played longer
train_on_both_cores "${oracle[@]}" --stage grounding --watch "$out/reaching" "$out/motor" "$out/longer"

play pair --episodes 105 --seed 1300000 --max-steps 1000 \
    --ponder-checkpoint "$out/run/grounding/ponder" --pounce-checkpoint "$out/run/motor/pounce"
mend motor hand 4
mend pair pair 2
mended=("$out"/mended/*/)
both=(--data "$out/data" "${mended[@]%/}")
train "${both[@]}" --stage mending --no-progress & mending=$!
train_on_both_cores "${both[@]}" --stage refining
wait $mending
train_on_both_cores "${both[@]}" --stage joint

"$bin/pp-eval" --tasks PickHighlight --episodes 60 --runs 1 --seed 1000 \
    --ponder-checkpoint "$out/run/ponder" --pounce-checkpoint "$out/run/pounce" --out "$out/real"
