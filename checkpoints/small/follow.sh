#!/usr/bin/env bash
# The shipped policy from the pair that train.sh has left, on two CPU cores: a PONDER that follows what moves and writes its plans
# down. See docs/training.md, "A PONDER that follows, and plans".
#
#     checkpoints/small/follow.sh [OUT]       (the OUT of train.sh)
#
# PONDER's eyes are opened again and kept. It learns from things that are moved aside, from the pair's own mistakes, and from
# films in which everything moves; it gets two more layers, laid out so that cognition stays with its thing; it learns to write
# down what comes later, from its own mistakes once more to have all places in mind, a third time to stay with what the hand has
# pushed, and a fourth time, in short rows, to see what is lit. The same command goes on after a kill.
set -euo pipefail

out=${1:-out/small}
bin=${BIN:-.venv/bin}
more=$out/follow
source "$(dirname "$0")/common.sh"
export OMP_NUM_THREADS=1 MUJOCO_GL=${MUJOCO_GL:-egl}

[ -d "$more/data/meta" ] || "$bin/pp-collect" --tasks PickHighlight --episodes 600 --noise dart --recovery-share 0.4 \
    --frames training --invocation-hz 5 --difficulties easy medium hard hard medium --order near-first --texts follow \
    --shove-share 0.7 --out "$more/data"
{ [ -d "$more/wander/meta" ] || "$bin/pp-wander" --episodes 600 --out "$more/wander"; } & wandering=$!
[ -d "$out/album/meta" ] || "$bin/pp-album" --pictures 10000 --out "$out/album"
wait $wandering

mend() {  # what a PONDER and a POUNCE do in scenes from SEED on is played into PLAYED and corrected into INTO
    local ponder=$1 pounce=$2 seed=$3 played=$4 into=$5 difficulty
    for difficulty in medium hard; do
        "$bin/pp-eval" --tasks PickHighlight --difficulty $difficulty --runs 1 --order near-first --record --record-hz 5 \
            --workers 2 --episodes 120 --seed "$seed" --max-steps 1000 --ponder-checkpoint "$ponder" \
            --pounce-checkpoint "$pounce" --out "$played/$difficulty"
        correct "$played/$difficulty" TIMEOUT 3 "$into/$difficulty-stuck"
        correct "$played/$difficulty" SUCCESS 1 "$into/$difficulty"
    done
}

mend "$out/run/ponder" "$out/run/pounce" 1400000 "$more/played" "$more/mended"
mended=("$more"/mended/*/)

[ -d "$more/eyes/ponder" ] || OMP_NUM_THREADS=2 "$bin/pp-see" --recipe small_refocusing --data "$more/data" \
    --album "$out/album" --ponder "$out/run/ponder" --steps 1500 --learning-rate 1e-3 --out "$more/eyes"

train() {  # the RECIPE from a PONDER and a POUNCE into OUT
    local recipe=$1 ponder=$2 pounce=$3 into=$4; shift 4
    [ -d "$into/ponder" ] || "$bin/torchrun" --nproc-per-node=2 -m dual_system.training.train --weights whole \
        --recipe "$recipe" --data "$more/data" "${mended[@]%/}" --ponder "$ponder" --pounce "$pounce" \
        --sights "$more/sights" --out "$into" "$@"
}

train small_refocusing "$more/eyes/ponder" "$out/run/pounce" "$more/refocusing" --watch "$more/wander"
[ -d "$more/heads/ponder" ] || "$bin/pp-follow" --ponder "$more/refocusing/ponder" --album "$out/album" \
    --data "$more/data" "$more/wander" --out "$more/heads"
train small_following "$more/heads/ponder" "$out/run/pounce" "$more/run" --stage refining --watch "$more/wander" --watch-share 0.3
train small_following "$more/heads/ponder" "$out/run/pounce" "$more/run" --stage joint
train small_planning "$more/run/ponder" "$out/run/pounce" "$more/planning" --watch "$more/wander" --watch-share 0.125

mend "$more/planning/ponder" "$more/run/pounce" 1500000 "$more/played-again" "$more/mended-again"
mended+=("$more"/mended-again/*/)
train small_retelling "$more/planning/ponder" "$more/run/pounce" "$more/last" --stage refining --watch "$more/wander" \
    --watch-share 0.125
train small_retelling "$more/planning/ponder" "$more/run/pounce" "$more/last" --stage joint
train small_retelling "$more/planning/ponder" "$more/run/pounce" "$more/last" --stage following --watch "$more/wander" \
    --watch-share 0.375

mend "$more/last/ponder" "$more/last/pounce" 1600000 "$more/played-thirdly" "$more/mended-thirdly"
mended+=("$more"/mended-thirdly/*/)
train small_keeping_up "$more/last/ponder" "$more/last/pounce" "$more/kept" --watch "$more/wander" --watch-share 0.25

mend "$more/kept/ponder" "$more/last/pounce" 1700000 "$more/played-fourthly" "$more/mended-fourthly"
mended+=("$more"/mended-fourthly/*/)
train small_noticing "$more/kept/ponder" "$more/last/pounce" "$more/noticed" --stage noticing --watch "$more/wander" \
    --watch-share 0.125
train small_noticing "$more/kept/ponder" "$more/last/pounce" "$more/noticed" --stage pointing --watch "$more/wander" \
    --watch-share 0.25

"$bin/pp-eval" --tasks PickHighlight --episodes 60 --runs 1 --seed 1000 \
    --ponder-checkpoint "$more/noticed/ponder" --pounce-checkpoint "$more/last/pounce" --out "$more/real"
