"""The tasks as gymnasium and dm_env environments.

Importing this package registers `vla/Tabletop-v0` with gymnasium.
"""

import gymnasium

gymnasium.register("vla/Tabletop-v0", "vla.envs.gym:Task", kwargs={"task": "tabletop"})
