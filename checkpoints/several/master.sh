#!/usr/bin/env bash
# A trial to go on from the pair that imitate.sh has left, on two CPU cores: see docs/training.md, "A lower loss, and no more
# scenes solved". recover.sh goes on from it.
#
#     checkpoints/several/master.sh [OUT]    (the OUT of train.sh, further.sh and imitate.sh)
#
# The pair plays, and PONDER goes on with what it has played, with instructions that ask for fewer rounds than were done, and with
# another optimiser; POUNCE learns StopCube's wait anew. The same command goes on after a kill. It was run by its parts and by hand.
set -euo pipefail

out=${1:-out/several}
more=$out/imitate
next=$out/master
bin=${BIN:-.venv/bin}
source "$(dirname "$0")/common.sh"
export OMP_NUM_THREADS=1 MUJOCO_GL=${MUJOCO_GL:-egl}
data=("$more/imitated" "$more/timed" "$more/shown" "$more/old" "$more/swaps" "$more/highlight")

watch() {  # what the pair plays becomes a dataset: EPISODES each from SEED on, FOLDER, TASKS
    local folder=$3 found
    play "$more/pair" "$1" "$2" "$folder-played" "${@:4}"
    mapfile -t found < <(logs "$folder-played")
    [ -d "$folder/meta" ] || "$bin/pp-export" "${found[@]}" --out "$folder"
}

watch 36 1950000 "$next/counted" PickXtimes SwingXtimes BinFill
watch 16 1960000 "$next/driven" ButtonUnmask VideoUnmask VideoPlaceButton VideoPlaceOrder PickHighlight

train() {  # on both cores
    "$bin/torchrun" --nproc-per-node=2 -m dual_system.training.train --weights whole --recipe small_mastering \
        --ponder "$more/run/settling/ponder" --pounce "$more/run/waiting/pounce" --sights "$more/sights" --out "$next/run" "$@"
}

[ -d "$next/run/settling/ponder" ] || train --stage settling --data "${data[@]}" \
    --watch "$more/watched" "$next/counted" "$next/driven" --watch-share 0.26
# StopCube four times as often as the rest
[ -d "$next/run/waiting/pounce" ] || train --stage waiting --data "${data[@]}" "$more/timed" "$more/timed" "$more/timed"

pair="$next/pair"
[ -d "$pair/ponder" ] || halve "$next/run/settling/ponder" "$pair/ponder"
[ -d "$pair/pounce" ] || halve "$next/run/waiting/pounce" "$pair/pounce"
evaluate "$pair" "$next"
