#!/usr/bin/env bash
# A PONDER that follows what moves and writes its plans down, from the pair that train.sh has left, on two CPU cores: see
# docs/training.md, "A PONDER that follows, and plans". The shipped policy is the one of train.sh; this one solved fewer.
#
#     checkpoints/small/follow.sh [OUT]       (the OUT of train.sh)
#
# PONDER's eyes are opened again and kept. It learns from things that are moved aside, from the pair's own mistakes, and from
# films in which everything moves; it gets two more layers, laid out so that cognition stays with its thing; at last it learns to
# write down what comes later. The same command goes on after a kill.
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

for difficulty in medium hard; do
    played=$more/played/$difficulty
    "$bin/pp-eval" --tasks PickHighlight --difficulty $difficulty --runs 1 --order near-first --record --record-hz 5 --workers 2 \
        --episodes 120 --seed 1400000 --max-steps 1000 --ponder-checkpoint "$out/run/ponder" \
        --pounce-checkpoint "$out/run/pounce" --out "$played"
    correct "$played" TIMEOUT 3 "$more/mended/$difficulty-stuck"
    correct "$played" SUCCESS 1 "$more/mended/$difficulty"
done
mended=("$more"/mended/*/)

[ -d "$more/eyes/ponder" ] || OMP_NUM_THREADS=2 "$bin/pp-see" --recipe small_refocusing --data "$more/data" \
    --album "$out/album" --ponder "$out/run/ponder" --steps 1500 --learning-rate 1e-3 --out "$more/eyes"

train() {  # the RECIPE from a PONDER into OUT
    local recipe=$1 ponder=$2 into=$3; shift 3
    [ -d "$into/ponder" ] || "$bin/torchrun" --nproc-per-node=2 -m ponderpounce.training.train --weights whole \
        --recipe "$recipe" --data "$more/data" "${mended[@]%/}" --ponder "$ponder" --pounce "$out/run/pounce" \
        --sights "$more/sights" --out "$into" "$@"
}

train small_refocusing "$more/eyes/ponder" "$more/refocusing" --watch "$more/wander"
[ -d "$more/heads/ponder" ] || "$bin/pp-follow" --ponder "$more/refocusing/ponder" --album "$out/album" \
    --data "$more/data" "$more/wander" --out "$more/heads"
train small_following "$more/heads/ponder" "$more/run" --stage refining --watch "$more/wander" --watch-share 0.3
train small_following "$more/heads/ponder" "$more/run" --stage joint
train small_planning "$more/run/ponder" "$more/planning" --watch "$more/wander" --watch-share 0.125

"$bin/pp-eval" --tasks PickHighlight --episodes 60 --runs 1 --seed 1000 \
    --ponder-checkpoint "$more/planning/ponder" --pounce-checkpoint "$more/run/pounce" --out "$more/real"
