#!/usr/bin/env bash
# Goes on from the pair that watch.sh has left, on two CPU cores: see docs/training.md, "Beginnings".
#
#     checkpoints/several/begin.sh [OUT]    (the OUT of the other scripts)
#
# The pair plays, and PONDER watches what it played and said; two rows of five end early, so that it reads more scenes in the
# same time. What note.sh and pace.sh have collected is used again. The same command goes on after a kill. It was run by its
# parts.
set -euo pipefail

out=${1:-out/several}
noted=$out/note
paced=$out/pace
watched=$out/watch
next=$out/begin
bin=${BIN:-.venv/bin}
source "$(dirname "$0")/common.sh"
export OMP_NUM_THREADS=1 MUJOCO_GL=${MUJOCO_GL:-egl}

pair=$watched/pair
play "$pair" 13 1999000 "$next/counted-played" PickXtimes SwingXtimes BinFill ButtonUnmask
play "$pair" 9 1999100 "$next/driven-played" VideoPlaceOrder VideoPlaceButton VideoUnmask PickHighlight VideoRepick ButtonUnmaskSwap
for played in counted driven; do
    retell "$next/$played-played" "$next/$played"
done
collect "$next/repick" --tasks VideoRepick --episodes 61 --recovery-share 0.2 --shove-share 0.3 --difficulties easy medium

data=("$paced/timed" "$noted/swaps" "$noted/swaps" "$noted/repick" "$next/repick" "$noted/shown" "$noted/shown" "$noted/old"
    "$noted/old" "$noted/filled" "$noted/filled" "$noted/imitated" "$noted/highlight" "$noted/highlight")
settle small_beginnings "$pair/ponder" "$pair/pounce" "$next" --data "${data[@]}" --sights "$noted/sights" \
    --watch "$watched/counted" "$next/counted" "$next/driven" --watch-share 0.2 --steps 1400
look_again "$next/pair/ponder" 6 8 'highlight|hides|correct'
evaluate "$next/pair" "$next"
