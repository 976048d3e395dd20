"""A study of one recording, one training run of 12 steps and one evaluation: a minute on one core, without a renderer."""

TINY = """
resources: {record: {cpus: 1}, train: {cpus: 1}, evaluate: {cpus: 1}}
grids:
  - tasks: [ManiFeel-PegInsertion-v1]
    obs_modes: [tacff]
    seeds: [0]
    demos: 1
    preset: cpu
    task_args: {fit: paper, max_episode_steps: 110, randomization: {socket_xy: 0.0, start_xy: 0.0, start_z: 0.0}}
    train: {steps: 12, save-every: 6, warmup-steps: 2, batch-size: 4, policy.down-dims: [8, 16]}
    episodes: 1
    checkpoints: 2
    half_precision: true
"""
