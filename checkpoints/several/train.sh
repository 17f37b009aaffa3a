#!/usr/bin/env bash
# The shipped pair learns seven more tasks, on two CPU cores: see docs/training.md, "Several tasks".
#
#     checkpoints/several/train.sh [OUT]      (`make setup` sets everything up first)
#
# PONDER's eyes are shown what there is in the other tasks, both get words for them, and then both learn from the oracle, each by
# itself on a core of its own: POUNCE from stand-ins, PONDER first in short rows. Every task is then played with cognition and
# without. The same command goes on after a kill.
set -euo pipefail

out=${1:-out/several}
bin=${BIN:-.venv/bin}
small=$(dirname "$0")/../small
export OMP_NUM_THREADS=1 MUJOCO_GL=${MUJOCO_GL:-egl}
others=(ButtonUnmask ButtonUnmaskSwap VideoUnmask VideoUnmaskSwap PickXtimes BinFill SwingXtimes)

collect() {  # into a folder, the oracle's way with these options
    local into=$1; shift
    [ -d "$into/meta" ] || "$bin/pp-collect" --frames training --invocation-hz 5 --difficulties easy medium hard \
        --order near-first --texts follow --noise dart --out "$into" "$@"
}

collect "$out/data" --tasks "${others[@]}" --episodes 100 --recovery-share 0.2 --shove-share 0.3
collect "$out/highlight" --tasks PickHighlight --episodes 150 --recovery-share 0.4 --shove-share 0.7
data=("$out/data" "$out/highlight")

for task in PickHighlight "${others[@]}"; do
    [ -d "$out/album/$task/meta" ] || "$bin/pp-album" --task "$task" --pictures 1200 --out "$out/album/$task"
done
[ -d "$out/eyes/ponder" ] || OMP_NUM_THREADS=2 "$bin/pp-see" --recipe small --data "$out/data" --album "$out"/album/* \
    --ponder "$small/ponder" --steps 1000 --learning-rate 1e-3 --out "$out/eyes"
[ -d "$out/wide/ponder" ] || "$bin/pp-widen" --ponder "$out/eyes/ponder" --pounce "$small/pounce" --data "${data[@]}" \
    --out "$out/wide"

train() {  # a STAGE
    "$bin/pp-train" --recipe small_several --stage "$1" --data "${data[@]}" --ponder "$out/wide/ponder" \
        --pounce "$out/wide/pounce" --sights "$out/sights" --out "$out/run" --no-progress
}
