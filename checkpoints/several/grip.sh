#!/usr/bin/env bash
# Serves the pair that specialise.sh has left with a firm grip: see docs/training.md, "A firm grip".
#
#     checkpoints/several/grip.sh [OUT]    (the OUT of the other scripts, specialise.sh among them)
#
# Nothing is trained. What was played before is played again first, to see what that changes. It was run by its parts.
set -euo pipefail

out=${1:-out/several}
six=$out/six
next=$out/eight
bin=${BIN:-.venv/bin}
source "$(dirname "$0")/common.sh"
export OMP_NUM_THREADS=1 MUJOCO_GL=${MUJOCO_GL:-egl}

mkdir -p "$next/first" "$next/pair"
cp -r "$six/first/ponder" "$six/first/pounce" "$next/first"
cp -r "$six/pair/ponder" "$six/pair/pounce" "$next/pair"
for pair in "$next/first" "$next/pair"; do
    grip_firmly "$pair" 0.0205 0.0295  # a cube of 4 cm held straight, and a little more than its diagonal
done
play "$next/first" 36 1990000 "$next/played" BinFill PickXtimes
for pair in six/first eight/first; do
    play "$out/$pair" 12 1991000 "$out/$pair-played" VideoRepick VideoUnmask VideoUnmaskSwap
done
evaluate "$next/pair" "$next"
