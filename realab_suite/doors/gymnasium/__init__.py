"""Worlds with the interface of Gymnasium.

Importing this package registers their ids:

    import gymnasium as gym
    import realab_suite.doors.gymnasium

    env = gym.make('realab/UnlockDoor-near-InstantaneousReward-v3')
"""

from realab_suite.doors.gymnasium import registration

registration.register_all()
