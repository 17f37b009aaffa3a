#!/usr/bin/env bash
# Goes on from the pair that narrow.sh has left, on two CPU cores: see docs/training.md, "A specialist".
#
#     checkpoints/several/specialise.sh [OUT]    (the OUT of the other scripts, narrow.sh among them)
#
# What counts gets layers of its own, which learn from what the pair itself has played. It was run by its parts.
set -euo pipefail

out=${1:-out/several}
two=$out/two
four=$out/four
next=$out/six
bin=${BIN:-.venv/bin}
source "$(dirname "$0")/common.sh"
export OMP_NUM_THREADS=1 MUJOCO_GL=${MUJOCO_GL:-egl}

fresh=(--first-episode 9200 --invocation-hz 2 --recovery-share 0.2 --shove-share 0.3)  # other scenes than all before
collect "$next/fill" --tasks BinFill --episodes 80 "${fresh[@]}"
collect "$next/counted" --tasks PickXtimes SwingXtimes --episodes 60 "${fresh[@]}"

mkdir -p "$next/first"
cp -r "$four/pair/ponder" "$four/pair/pounce" "$next/first"
take_none "$next/first/ponder"
play "$next/first" 36 1990000 "$next/played" BinFill SwingXtimes PickXtimes
retell "$next/played" "$next/own"

learn small_specializing settling "$out/long/pair/ponder" "$four/pair/pounce" "$next" --tasks PickXtimes SwingXtimes BinFill \
    --data "$next/fill" "$next/counted" "$next/counted" "$two/fill" "$two/old" --sights "$two/sights" \
    --watch "$next/own" "$next/own" "$two/watched" --watch-share 0.5 --products bfloat16
mkdir -p "$next/pair"
cp -r "$four/pair/ponder" "$four/pair/pounce" "$next/pair"
give_specialist "$next/run/settling/ponder" "$next/pair/ponder" counting 10 3
pack "$next/pair/ponder"
evaluate "$next/pair" "$next"
