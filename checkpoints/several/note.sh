#!/usr/bin/env bash
# A trial to go on from the pair that recover.sh has left, on two CPU cores: see docs/training.md, "Notes".
#
#     checkpoints/several/note.sh [OUT]    (the OUT of the other scripts)
#
# PONDER learns to write down what moves, and what a demonstration does, while it sees it; from the oracle's episodes and from
# what the pair plays. The same command goes on after a kill. It was run by its parts.
set -euo pipefail

out=${1:-out/several}
before=$out/recover
next=$out/note
bin=${BIN:-.venv/bin}
source "$(dirname "$0")/common.sh"
export OMP_NUM_THREADS=1 MUJOCO_GL=${MUJOCO_GL:-egl}

noisy=(--recovery-share 0.2 --shove-share 0.3)
collect "$next/old" --tasks ButtonUnmask VideoUnmask PickXtimes SwingXtimes --episodes 90 "${noisy[@]}"
collect "$next/filled" --tasks BinFill --episodes 140 "${noisy[@]}"
collect "$next/imitated" --tasks MoveCube PatternLock RouteStick --episodes 90 "${noisy[@]}"
collect "$next/highlight" --tasks PickHighlight --episodes 120 --recovery-share 0.4 --shove-share 0.7
collect "$next/timed" --tasks StopCube --episodes 150 --invocation-hz 20
collect "$next/swaps" --tasks ButtonUnmaskSwap VideoUnmaskSwap --episodes 80 "${noisy[@]}"
collect "$next/repick" --tasks VideoRepick --episodes 110 "${noisy[@]}"
collect "$next/shown" --tasks VideoPlaceButton VideoPlaceOrder --episodes 70 "${noisy[@]}"
data=("$next/timed" "$next/timed" "$next/swaps" "$next/swaps" "$next/repick" "$next/shown" "$next/old" "$next/filled"
    "$next/imitated" "$next/highlight")

play "$before/pair" 28 1990000 "$next/counted-played" PickXtimes SwingXtimes BinFill
play "$before/pair" 12 1995000 "$next/driven-played" VideoPlaceButton VideoPlaceOrder ButtonUnmask VideoUnmask
for played in counted driven; do retell "$next/$played-played" "$next/$played"; done

settle small_noting "$before/pair/ponder" "$before/pair/pounce" "$next" --data "${data[@]}" --sights "$next/sights" \
    --watch "$next/counted" "$next/driven" --watch-share 0.25
evaluate "$next/pair" "$next"
