#!/usr/bin/env bash
# Every row of the paper's tables that is Diffusion Policy's, three seeds each (a GPU is expected); `make data` records first.
#   baselines/diffusion_policy/baselines.sh [FOLDER OF DEMONSTRATIONS]
set -euo pipefail
demos=${1:-data/demos}

train() { # NAME TASK OBS-MODE [further flags]
  local name=$1 task=$2 mode=$3
  shift 3
  for seed in 0 1 2; do
    python baselines/diffusion_policy/train.py paper --demos "$demos/ManiFeel-$task-v1/trajectory.h5" \
      --env-id "ManiFeel-$task-v1" --obs-mode "$mode" --seed "$seed" --eval-episodes 50 \
      --run-dir "runs/diffusion_policy/$name/$task/$mode/$seed" "$@"
  done
}
camera() { # the policy's, of a task
  case $1 in PegReorientation | ObjectSearch | BallSorting*) echo front ;; *) echo wrist ;; esac
}

# Table I: every task in three sensing set-ups; gear and sorting with 50 of the demonstrations
for task in PegInsertion USBInsertion PowerPlugInsertion GearAssembly NutBoltAssembly BulbInstallation PegReorientation \
  ObjectSearch BallSortingDim; do
  few=()
  case $task in GearAssembly | BallSorting*) few=(--num-demos 50) ;; esac
  for mode in rgb rgb+tacrgb rgb+tacff; do
    train table1 "$task" "$mode" --cameras "$(camera "$task")" "${few[@]}"
  done
done

# Table II: sorting in normal light (the other rows are Table I's)
for mode in rgb rgb+tacrgb rgb+tacff; do
  train table2 BallSorting "$mode" --cameras front --num-demos 50
done

# Table III: tactile representations (see baselines/tactile_representations for their weights)
weights=${WEIGHTS:-weights}
for task in GearAssembly ObjectSearch BallSorting; do
  view=$(camera "$task")
  train table3/unit "$task" rgb+tacrgb --cameras "$view" --policy.encoder.tacrgb unit --tacrgb-weights "$weights/unit.safetensors"
  for name in t3 anytouch; do
    source=$weights/t3_medium
    if [ $name = anytouch ]; then source=$weights/anytouch.pth; fi
    train "table3/$name" "$task" rgb+tacrgb --cameras "$view" --image-size 224 \
      --policy.encoder.tacrgb $name --tacrgb-weights "$source"
  done
done

# Number of demonstrations (gear assembly)
for count in 20 40 60 80 100; do
  train "demos/$count" GearAssembly rgb+tacff --num-demos "$count"
done

# Viewpoint (object search)
for view in front wrist; do
  for mode in rgb rgb+tacrgb; do
    train "viewpoint/$view" ObjectSearch "$mode" --cameras "$view"
  done
done
