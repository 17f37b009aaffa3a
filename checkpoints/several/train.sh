#!/usr/bin/env bash
# The shipped pair learns seven more tasks, on two CPU cores: see docs/training.md, "Several tasks". further.sh goes on from it.
#
#     checkpoints/several/train.sh [OUT]      (`make setup` sets everything up first)
#
# PONDER's eyes are shown what there is in the other tasks, both get words for them, and then both learn from the oracle, each by
# itself: POUNCE from stand-ins, PONDER in short rows and whole ones by turns. Every task is then played with cognition and
# without. The same command goes on after a kill. Under two hours by the minutes of its parts, without the playing; these were run
# by hand, it never was.
set -euo pipefail

out=${1:-out/several}
bin=${BIN:-.venv/bin}
small=$(dirname "$0")/../small
source "$small/common.sh"
export OMP_NUM_THREADS=1 MUJOCO_GL=${MUJOCO_GL:-egl}
others=(ButtonUnmask ButtonUnmaskSwap VideoUnmask VideoUnmaskSwap PickXtimes BinFill SwingXtimes)

collect "$out/data" --tasks "${others[@]}" --episodes 100 --recovery-share 0.2 --shove-share 0.3
collect "$out/highlight" --tasks PickHighlight --episodes 150 --recovery-share 0.4 --shove-share 0.7
data=("$out/data" "$out/highlight")

look() {  # at so many PICTURES of a TASK
    [ -d "$out/album/$2/meta" ] || "$bin/pp-album" --task "$2" --pictures "$1" --out "$out/album/$2"
}

look 2000 PickHighlight
for task in ButtonUnmask ButtonUnmaskSwap PickXtimes BinFill SwingXtimes; do look 1200 $task; done
look 800 VideoUnmask
[ -d "$out/eyes/ponder" ] || OMP_NUM_THREADS=2 "$bin/pp-see" --recipe small --data "$out/data" --album "$out"/album/* \
    --ponder "$small/ponder" --steps 1000 --learning-rate 1e-3 --out "$out/eyes"
[ -d "$out/wide/ponder" ] || "$bin/pp-widen" --ponder "$out/eyes/ponder" --pounce "$small/pounce" --data "${data[@]}" \
    --out "$out/wide"

how=(--recipe small_several --data "${data[@]}" --ponder "$out/wide/ponder" --pounce "$out/wide/pounce" --sights "$out/sights"
    --out "$out/run")
[ -d "$out/run/hand/pounce" ] || "$bin/pp-train" "${how[@]}" --stage hand & acting=$!
[ -d "$out/run/noticing/ponder" ] || "$bin/pp-train" "${how[@]}" --stage noticing --no-progress
wait $acting
[ -d "$out/run/ponder" ] || "$bin/torchrun" --nproc-per-node=2 -m dual_system.training.train --weights whole "${how[@]}"

pair="$out/pair"
[ -d "$pair/ponder" ] || halve "$out/run/ponder" "$pair/ponder"
[ -d "$pair/pounce" ] || halve "$out/run/hand/pounce" "$pair/pounce"

for cognition in real null; do
    "$bin/pp-eval" --tasks PickHighlight "${others[@]}" --episodes 50 --runs 1 --seed 1000 --workers 2 \
        --cognition $cognition --ponder-checkpoint "$pair/ponder" --pounce-checkpoint "$pair/pounce" --out "$out/$cognition"
done
"$bin/pp-tables" "$out/real" "$out/null" --out "$out/tables"
