#!/usr/bin/env bash
# A trial to go on from the pair that watch.sh has left, on two CPU cores: see docs/training.md, "Where it will come to rest".
#
#     checkpoints/several/foresee.sh [OUT]    (the OUT of the other scripts)
#
# PONDER learns to note where things that change places are going: first from the beginnings of such episodes alone, then
# among all others. What note.sh, pace.sh and watch.sh have collected is used again. The same command goes on after a kill. It
# was run by its parts.
set -euo pipefail

out=${1:-out/several}
noted=$out/note
paced=$out/pace
watched=$out/watch
next=$out/foresee
bin=${BIN:-.venv/bin}
source "$(dirname "$0")/common.sh"
export OMP_NUM_THREADS=1 MUJOCO_GL=${MUJOCO_GL:-egl}

noisy=(--recovery-share 0.2 --shove-share 0.3)
collect "$next/video-swaps" --tasks VideoUnmaskSwap --episodes 240 "${noisy[@]}"
collect "$next/button-swaps" --tasks ButtonUnmaskSwap --episodes 240 "${noisy[@]}"
collect "$next/repick" --tasks VideoRepick --episodes 61 "${noisy[@]}" --difficulties easy medium

ponder=$watched/pair/ponder pounce=$watched/pair/pounce
swaps=("$next/video-swaps" "$next/button-swaps" "$noted/repick")
learn small_foreseeing following "$ponder" "$pounce" "$next" --data "${swaps[@]}" --sights "$noted/sights"
data=("$paced/timed" "${swaps[@]}" "$next/video-swaps" "$next/button-swaps" "$next/repick" "$noted/shown" "$noted/shown"
    "$noted/old" "$noted/filled" "$noted/imitated" "$noted/highlight")
settle small_foreseeing "$next/run/following/ponder" "$pounce" "$next" --data "${data[@]}" --sights "$noted/sights" \
    --watch "$watched/counted" --watch-share 0.15
evaluate "$next/pair" "$next"
