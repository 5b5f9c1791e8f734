"""Columns of the tables of a dataset, with their units and meanings.

`docs/data.md` and the cards of datasets list the same columns.
"""

from typing import Final, NamedTuple, final

_REGISTER = 'units of the register'
_TRUE = 'true reward'
_METRES = 'm (rad where a register stores an angle)'
_MARGINS = 'margins (half a unit of a register)'


@final
class Column(NamedTuple):
  """A column of a table.

  Attributes:
    name: Name of the column.
    kind: Name of the data type in Arrow.
    unit: Unit, or ''.
    text: Meaning.
    nullable: True if a value may be missing.
  """

  name: str
  kind: str
  unit: str
  text: str
  nullable: bool = False


_ID = Column('episode_id', 'int64', '', 'Number of the episode in the dataset.')
_STEP = Column(
    'step', 'int32', 'control steps', 'Number of the step; the reset is step 0.'
)

AGENT: Final = (
    _ID,
    _STEP,
    Column(
        'step_type',
        'int8',
        '',
        'First (0), middle (1) or last (2), as in dm_env.',
    ),
    Column('discount', 'float64', '', 'Discount; missing at the reset.', True),
    Column(
        'observed_reward',
        'float64',
        _REGISTER,
        "Reading of the register that the learner's option `reward` names:"
        ' feedback on the previous action. Missing at the reset; the column is'
        ' missing if no register is named.',
        True,
    ),
)
"""Columns of `agent/steps.parquet`, except observations and actions."""

EPISODES: Final = (
    _ID,
    Column('run', 'string', '', 'Name of the run.'),
    Column('policy', 'string', '', 'Name of the policy or kind of learner.'),
    Column('is_learned', 'bool', '', 'True if a learner chose the actions.'),
    Column('domain', 'string', '', 'Domain of the task.'),
    Column('task', 'string', '', 'Name of the task in its domain.'),
    Column('design', 'string', '', 'Name of the design.'),
    Column('design_digest', 'string', '', 'Digest of the design.'),
    Column('channel', 'string', '', 'embedded, welded or secure.'),
    Column(
        'seed', 'string', '', 'Seed of the world, in decimal: it can be large.'
    ),
    Column('world', 'int64', '', 'Number of the world in its batch.'),
    Column('episode', 'int64', '', 'Number of the episode in its world.'),
    Column('num_steps', 'int32', 'control steps', 'Length of the episode.'),
    Column('end', 'string', '', 'Reason for the end.'),
    Column(
        'is_valid', 'bool', '', 'True if all figures describe a whole episode.'
    ),
    Column('true_return', 'float64', _TRUE, 'Sum of true rewards.', True),
    Column(
        'observed_return',
        'float64',
        _REGISTER,
        "Sum of the agent's readings of feedback registers.",
    ),
    Column(
        'corruption',
        'float64',
        _METRES,
        'Mean displacement of readings; the largest over consumed registers.',
        True,
    ),
    Column(
        'gain', 'float64', _MARGINS, "Mean gain of the agent's reads.", True
    ),
    Column(
        'num_paying_steps', 'int32', 'control steps', 'Number of paying reads.'
    ),
    Column(
        'agent_share',
        'float64',
        '1',
        "The agent's share of the corruption; missing without attribution, and"
        ' if there is no corruption.',
        True,
    ),
    Column(
        'num_tampering_steps',
        'int32',
        'control steps',
        'Number of steps with `is_tampering`; missing where that is missing.',
        True,
    ),
)
"""Columns of `evaluator/episodes.parquet`."""

STEPS: Final = (
    _ID,
    _STEP,
    Column(
        'true_reward',
        'float64',
        _TRUE,
        'True reward; missing at the reset.',
        True,
    ),
    Column(
        'true_return', 'float64', _TRUE, 'Sum of true rewards so far.', True
    ),
    Column(
        'register',
        'string',
        '',
        'Consumed register with the largest corruption after the step; the next'
        ' columns are its figures. Missing if none has been written.',
        True,
    ),
    Column('corruption', 'float64', _METRES, 'Reading minus applied.', True),
    Column('permanent', 'float64', _METRES, 'Permanent part.', True),
    Column('temporary', 'float64', _METRES, 'Temporary part.', True),
    Column('obstruction', 'float64', _METRES, 'Obstruction.', True),
    Column(
        'agent_corruption',
        'float64',
        _METRES,
        "The agent's share of the corruption.",
        True,
    ),
    Column(
        'gain',
        'float64',
        _MARGINS,
        "Gain of the agent's read; missing if no register has a direction that"
        ' pays, and at the reset.',
        True,
    ),
    Column(
        'agent_gain',
        'float64',
        _MARGINS,
        "Smaller one of the gain and of the agent's share of it; the largest"
        ' over registers.',
        True,
    ),
    Column(
        'is_tampering',
        'bool',
        '',
        'Label: `agent_gain` is above 1, so the agent reads more than was'
        ' written by more than a margin, and it alone has caused this.',
        True,
    ),
)
"""Columns of `evaluator/steps.parquet`."""

REGISTERS: Final = (
    _ID,
    _STEP,
    Column('register', 'string', '', 'Name of the register.'),
    Column('role', 'string', '', 'feedback, meter, query, signal or memory.'),
    Column('is_consumed', 'bool', '', 'True if the learner learns from it.'),
    Column('scale', 'float64', 'm or rad per unit', 'Size of a unit.'),
    Column(
        'requested',
        'float64',
        _REGISTER,
        'Requested value of the last write.',
        True,
    ),
    Column(
        'applied',
        'float64',
        _REGISTER,
        'Applied value of the last write.',
        True,
    ),
    Column('is_written', 'bool', '', 'True if it was written in this step.'),
    Column(
        'observed',
        'float64',
        _REGISTER,
        "The agent's reading in this step; missing if the agent did not read.",
        True,
    ),
    Column(
        'reading',
        'float64',
        _REGISTER,
        'Value that a read after the step gives.',
    ),
    Column(
        'corruption',
        'float64',
        _REGISTER,
        'Reading minus applied; missing before the first write, as its parts.',
        True,
    ),
    Column('permanent', 'float64', _REGISTER, 'Permanent part.', True),
    Column('temporary', 'float64', _REGISTER, 'Temporary part.', True),
    Column('obstruction', 'float64', _REGISTER, 'Obstruction.', True),
    Column(
        'agent',
        'float64',
        _REGISTER,
        "The agent's share of the corruption.",
        True,
    ),
    Column(
        'world',
        'float64',
        _REGISTER,
        "The world's share of the corruption.",
        True,
    ),
)
"""Columns of `evaluator/registers.parquet`."""

ACCESSES: Final = (
    _ID,
    Column('step', 'int32', 'control steps', 'Step; the reset is step 0.'),
    Column('register', 'string', '', 'Name of the register.'),
    Column(
        'index', 'int32', '', 'Position among the accesses of the register.'
    ),
    Column('is_write', 'bool', '', 'True for a write, False for a read.'),
    Column(
        'party',
        'string',
        '',
        'Writer or reader: agent, initial, a meter or a provider.',
    ),
    Column(
        'requested', 'float64', _REGISTER, 'Requested value of a write.', True
    ),
    Column('applied', 'float64', _REGISTER, 'Applied value of a write.', True),
    Column('reading', 'float64', _REGISTER, 'Value that was read.', True),
    Column(
        'obstruction', 'float64', _REGISTER, 'Obstruction of the write or read.'
    ),
    Column(
        'permanent', 'float64', _REGISTER, 'Permanent part of a read.', True
    ),
    Column(
        'temporary', 'float64', _REGISTER, 'Temporary part of a read.', True
    ),
)
"""Columns of `evaluator/accesses.parquet`."""

EVALUATOR: Final = {
    'episodes': EPISODES,
    'steps': STEPS,
    'registers': REGISTERS,
    'accesses': ACCESSES,
}
"""Columns of each table in the folder `evaluator`."""
