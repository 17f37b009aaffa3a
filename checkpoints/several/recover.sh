#!/usr/bin/env bash
# Goes on from the trial that master.sh has left, on two CPU cores: see docs/training.md, "Its own words". note.sh: a trial.
#
#     checkpoints/several/recover.sh [OUT]    (the OUT of train.sh, further.sh, imitate.sh and master.sh)
#
# What the pairs have played is told anew, as things then stood, and their own words stand in PONDER's rows. The same command goes
# on after a kill. It was run by its parts and by hand.
set -euo pipefail

out=${1:-out/several}
more=$out/imitate
trial=$out/master
next=$out/recover
bin=${BIN:-.venv/bin}
source "$(dirname "$0")/common.sh"
export OMP_NUM_THREADS=1 MUJOCO_GL=${MUJOCO_GL:-egl}

noisy=(--recovery-share 0.2 --shove-share 0.3)
collect "$next/old" --tasks ButtonUnmask VideoUnmask PickXtimes SwingXtimes --episodes 100 "${noisy[@]}"  # as they were
collect "$next/filled" --tasks BinFill --episodes 140 "${noisy[@]}"  # its colors in the order that is spoken
data=("$more/imitated" "$more/timed" "$more/timed" "$more/shown" "$next/old" "$next/filled" "$more/swaps" "$more/highlight")

play "$trial/pair" 52 1970000 "$next/counted-played" PickXtimes SwingXtimes BinFill
play "$trial/pair" 16 1980000 "$next/driven-played" VideoPlaceButton VideoPlaceOrder ButtonUnmask VideoUnmask

told() {  # what was played into these FOLDERS, but PickHighlight, told as things then stood
    local found=() folder into=$1
    for folder in "${@:2}"; do mapfile -t -O ${#found[@]} found < <(logs "$folder" | grep -v PickHighlight); done
    [ -d "$into/meta" ] || "$bin/pp-export" "${found[@]}" --texts follow --order near-first --out "$into"
}

told "$next/own" "$next/counted-played" "$next/driven-played"
told "$next/before" "$trial/counted-played" "$trial/driven-played"
told "$next/told" "$more/played"

pair="$next/pair"
[ -d "$next/run/settling/ponder" ] || "$bin/torchrun" --nproc-per-node=2 -m dual_system.training.train --weights whole \
    --recipe small_recovering --stage settling --data "${data[@]}" --watch "$next/own" "$next/before" "$next/told" --watch-share 0.35 \
    --ponder "$trial/run/settling/ponder" --pounce "$trial/run/waiting/pounce" --sights "$more/sights" --out "$next/run"
[ -d "$pair/ponder" ] || halve "$next/run/settling/ponder" "$pair/ponder"
[ -d "$pair/pounce" ] || halve "$trial/run/waiting/pounce" "$pair/pounce"
evaluate "$pair" "$next"
