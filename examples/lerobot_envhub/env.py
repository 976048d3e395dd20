"""The file that LeRobot's EnvHub loads: `make_env("USER/REPOSITORY", trust_remote_code=True)` calls `make_env` of this file.

Put this folder into a repository of the Hub. manifeel-ms3 must be installed where it is loaded (requirements.txt).
"""

from manifeel_ms3.evaluation.lerobot_env import make_env

__all__ = ["make_env"]
