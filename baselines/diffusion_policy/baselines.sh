#!/usr/bin/env bash
# PegInsertion in the paper's three sensing set-ups, three seeds each (a GPU is expected).
set -euo pipefail
demos=${1:-data/demos/ManiFeel-PegInsertion-v1/trajectory.h5}
for seed in 0 1 2; do
  for mode in rgb rgb+tacrgb rgb+tacff; do
    run=runs/diffusion_policy/peg-insertion/$mode/$seed
    python baselines/diffusion_policy/train.py paper --demos "$demos" --obs-mode "$mode" --seed "$seed" --run-dir "$run"
    python -m manifeel_ms3.evaluation.run --checkpoint "$run/checkpoints/last" --workers 4
  done
done
