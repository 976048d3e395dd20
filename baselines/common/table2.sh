#!/usr/bin/env bash
# A policy's rows of the paper's Table II, three seeds each (a GPU is expected); `make data` records first.
#   baselines/common/table2.sh POLICY [FOLDER OF DEMONSTRATIONS]
set -euo pipefail
policy=$1 demos=${2:-data/demos}

for task in GearAssembly BulbInstallation ObjectSearch BallSorting; do
  view=wrist few=()
  case $task in ObjectSearch | BallSorting) view=front ;; esac
  case $task in GearAssembly | BallSorting) few=(--num-demos 50) ;; esac
  for mode in rgb rgb+tacrgb rgb+tacff; do
    for seed in 0 1 2; do
      python "baselines/$policy/train.py" paper --demos "$demos/ManiFeel-$task-v1/trajectory.h5" \
        --env-id "ManiFeel-$task-v1" --obs-mode "$mode" --cameras $view --seed $seed --eval-episodes 50 \
        --run-dir "runs/$policy/table2/$task/$mode/$seed" "${few[@]}"
    done
  done
done
