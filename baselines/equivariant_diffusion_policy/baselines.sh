#!/usr/bin/env bash
# This policy's rows of the paper's Table II.
#   baselines/equivariant_diffusion_policy/baselines.sh [FOLDER OF DEMONSTRATIONS]
exec "$(dirname "$0")/../common/table2.sh" equivariant_diffusion_policy "$@"
