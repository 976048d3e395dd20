#!/usr/bin/env bash
# This policy's rows of the paper's Table II.
#   baselines/flow_matching/baselines.sh [FOLDER OF DEMONSTRATIONS]
exec "$(dirname "$0")/../common/table2.sh" flow_matching "$@"
