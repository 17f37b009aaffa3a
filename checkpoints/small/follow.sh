#!/usr/bin/env bash
# A PONDER that follows what moves, from the pair that train.sh has left, on two CPU cores: see docs/training.md, "A PONDER
# that follows". The shipped policy is the one of train.sh; this one solved as many scenes, not more.
#
#     checkpoints/small/follow.sh [OUT]       (the OUT of train.sh)
#
# PONDER's eyes are opened again and kept. It learns from things that are moved aside, from the pair's own mistakes, and from
# films in which everything moves; it gets two more layers, laid out so that cognition stays with its thing. The same command
# goes on after a kill.
set -euo pipefail

out=${1:-out/small}
bin=${BIN:-.venv/bin}
more=$out/follow
export OMP_NUM_THREADS=1 MUJOCO_GL=${MUJOCO_GL:-egl}

logs() {  # of finished episodes that the pair played and that ended with a STATUS
    "$bin/python" -c 'import json, pathlib, sys
folder, wanted = pathlib.Path(sys.argv[1]), sys.argv[2]
for each in json.loads((folder / "results.json").read_text())["episodes"]:
    if each["status"] == wanted:
        print(folder / each["mcap"])' "$more/played" "$1"
}

correct() {  # the oracle takes them over, each so many times
    local status=$1 times=$2 found
    mapfile -t found < <(logs "$status")
    if [ ${#found[@]} -gt 0 ] && [ ! -d "$more/mended/$status/meta" ]; then
        rm -rf "$more/mended/$status"  # a kill left the beginning
        "$bin/pp-correct" "${found[@]}" --order near-first --look-hz 1 --per-episode "$times" --out "$more/mended/$status"
    fi
}

[ -d "$more/data/meta" ] || "$bin/pp-collect" --tasks PickHighlight --episodes 600 --noise dart --recovery-share 0.4 \
    --frames training --invocation-hz 5 --difficulties easy medium hard hard medium --order near-first --texts follow \
    --shove-share 0.7 --out "$more/data"
[ -d "$more/wander/meta" ] || "$bin/pp-wander" --episodes 600 --out "$more/wander"
[ -d "$out/album/meta" ] || "$bin/pp-album" --pictures 10000 --out "$out/album"

"$bin/pp-eval" --tasks PickHighlight --runs 1 --order near-first --record --record-hz 5 --workers 2 --episodes 150 \
    --seed 1400000 --max-steps 1000 --ponder-checkpoint "$out/run/ponder" --pounce-checkpoint "$out/run/pounce" \
    --out "$more/played"
correct TIMEOUT 3
correct SUCCESS 1
mended=("$more"/mended/*/)

[ -d "$more/eyes/ponder" ] || OMP_NUM_THREADS=2 "$bin/pp-see" --recipe small_following --data "$more/data" \
    --album "$out/album" --ponder "$out/run/ponder" --steps 1500 --learning-rate 1e-3 --out "$more/eyes"

train() {
    [ -d "$more/run/ponder" ] || "$bin/torchrun" --nproc-per-node=2 -m ponderpounce.training.train --recipe small_following \
        --data "$more/data" "${mended[@]%/}" --out "$more/run" --pounce "$out/run/pounce" --sights "$more/sights" "$@"
}

train --stage refocusing --ponder "$more/eyes/ponder" --watch "$more/wander"
[ -d "$more/heads/ponder" ] || "$bin/pp-follow" --ponder "$more/run/refocusing/ponder" --album "$out/album" \
    --data "$more/data" "$more/wander" --out "$more/heads"
if [ ! -d "$more/run/refocusing/unled" ]; then  # what comes next goes on from the one with heads
    mv "$more/run/refocusing/ponder" "$more/run/refocusing/unled"
    cp -r "$more/heads/ponder" "$more/run/refocusing/ponder"
fi
train --stage following --watch "$more/wander"
train --stage refining --watch "$more/wander" --watch-share 0.3
train --stage joint

"$bin/pp-eval" --tasks PickHighlight --episodes 60 --runs 1 --seed 1000 \
    --ponder-checkpoint "$more/run/ponder" --pounce-checkpoint "$more/run/pounce" --out "$more/real"
