#!/usr/bin/env bash
# The pair for several tasks from the one that train.sh has left, on two CPU cores: see docs/training.md, "Three tasks more".
#
#     checkpoints/several/further.sh [OUT]    (the OUT of train.sh)
#
# Three tasks with long demonstrations are added. POUNCE learns to be told what a thing is picked up for, and not to let go of it
# too early. In between it plays, told the task's own subgoals, and PONDER learns from what it sees of that, too. The same command
# goes on after a kill. It was run by its parts and by hand, never as one.
set -euo pipefail

out=${1:-out/several}
bin=${BIN:-.venv/bin}
more=$out/further
source "$(dirname "$0")/../small/common.sh"
export OMP_NUM_THREADS=1 MUJOCO_GL=${MUJOCO_GL:-egl}
counting=(PickXtimes SwingXtimes BinFill)
covered=(VideoUnmask ButtonUnmask)
swapped=(ButtonUnmaskSwap VideoUnmaskSwap)
shown=(VideoPlaceButton VideoPlaceOrder VideoRepick)

noisy=(--recovery-share 0.2 --shove-share 0.3)
collect "$more/data" --tasks "${counting[@]}" "${covered[@]}" --episodes 100 "${noisy[@]}"
collect "$more/swaps" --tasks "${swapped[@]}" --episodes 40 "${noisy[@]}"
collect "$more/video" --tasks "${shown[@]}" --episodes 100 "${noisy[@]}"
collect "$more/highlight" --tasks PickHighlight --episodes 150 --recovery-share 0.4 --shove-share 0.7

how=(--recipe small_further --data "$more/data" "$more/swaps" "$more/video" "$more/highlight" --ponder "$out/pair/ponder"
    --pounce "$out/pair/pounce" --sights "$more/sights" --out "$more/run")
{
    for stage in binding pointing; do
        [ -d "$more/run/$stage/ponder" ] || "$bin/pp-train" "${how[@]}" --stage $stage --no-progress
    done
} & telling=$!
[ -d "$more/run/hand/pounce" ] || "$bin/pp-train" "${how[@]}" --stage hand
"$bin/pp-eval" --tasks SwingXtimes --runs 1 --episodes 30 --seed 1900000 --max-steps 800 --order near-first --record --record-hz 5 \
    --cognition stand-in --stand-in-noise-px 2 --pounce-checkpoint "$more/run/hand/pounce" --out "$more/played"
mapfile -t found < <(logs "$more/played")
[ -d "$more/watched/meta" ] || "$bin/pp-export" "${found[@]}" --out "$more/watched"
[ -d "$more/run/releasing/pounce" ] || "$bin/pp-train" "${how[@]}" --stage releasing
wait $telling
[ -d "$more/run/ponder" ] || "$bin/torchrun" --nproc-per-node=2 -m dual_system.training.train --weights whole "${how[@]}" \
    --stage finishing --watch "$more/watched" --watch-share 0.125

pair="$more/pair"
[ -d "$pair/ponder" ] || halve "$more/run/ponder" "$pair/ponder"
[ -d "$pair/pounce" ] || halve "$more/run/releasing/pounce" "$pair/pounce"
for cognition in real null; do
    "$bin/pp-eval" --tasks PickHighlight "${counting[@]}" "${covered[@]}" "${swapped[@]}" "${shown[@]}" --episodes 50 --runs 1 \
        --seed 1000 --workers 2 --cognition $cognition --ponder-checkpoint "$pair/ponder" --pounce-checkpoint "$pair/pounce" \
        --out "$more/$cognition"
done
"$bin/pp-tables" "$more/real" "$more/null" --out "$more/tables"
