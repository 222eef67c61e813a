"""Write a policy as a folder for `--policy.path`: python -m lerobot_policy_vla RUN FOLDER."""

import sys
from pathlib import Path

from lerobot_policy_vla import VlaConfig, VlaPolicy, make_vla_pre_post_processors


def main(checkpoint: str, folder: str) -> None:
    """Write the policy and its processors."""
    config = VlaConfig(checkpoint=checkpoint)
    VlaPolicy(config).save_pretrained(Path(folder))
    for pipeline in make_vla_pre_post_processors(config):
        pipeline.save_pretrained(Path(folder))


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    try:
        main(*sys.argv[1:])
    except ValueError as error:
        sys.exit(f"error: {error}")
