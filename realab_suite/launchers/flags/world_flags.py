"""Flags that choose a world, a design and the target of saboteurs."""

from absl import flags

DOMAIN = flags.DEFINE_string(
    'domain', 'unlock_door', 'The world: unlock_door or collect_apples.'
)
TASK = flags.DEFINE_string(
    'task', 'standard', 'Its variation: standard, near, far or boxed.'
)
DESIGN = flags.DEFINE_string(
    'design',
    'instantaneous_reward',
    'The agent design: the name of a shipped one, or the path of a YAML file.',
)
SET = flags.DEFINE_multi_string(
    'set',
    [],
    'A dotted override of the design, as in --set=registers.reward.scale=0.2;'
    ' may be repeated.',
)
MAX_STEPS = flags.DEFINE_integer(
    'max_steps', 250, 'Length of an episode, in control steps.'
)
TARGET = flags.DEFINE_string(
    'target',
    None,
    'The register that saboteurs attack; by default the first feedback'
    ' register.',
)
