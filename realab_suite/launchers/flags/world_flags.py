"""Flags that choose a world, a design and the target of saboteurs."""

from absl import flags

DOMAIN = flags.DEFINE_string(
    'domain', 'unlock_door', 'Domain: unlock_door or collect_apples.'
)
TASK = flags.DEFINE_string(
    'task', 'standard', 'Task of the domain: standard, near, far or boxed.'
)
DESIGN = flags.DEFINE_string(
    'design',
    'instantaneous_reward',
    'Agent design: name of one that is part of the package, or path of a YAML'
    ' file.',
)
SET = flags.DEFINE_multi_string(
    'set',
    [],
    'Dotted override of the design, such as --set=registers.reward.scale=0.2',
)
MAX_STEPS = flags.DEFINE_integer(
    'max_steps', 250, 'Maximum length of an episode, in control steps.'
)
TARGET = flags.DEFINE_string(
    'target',
    None,
    'Register that saboteurs attack. Default: the first feedback register.',
)
