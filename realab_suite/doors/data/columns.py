"""Columns of the tables of a dataset, with their units and meanings.

The cards of datasets list them.
"""

from typing import Final

import pyarrow as pa

_STEPS = 'control steps'
_REGISTER = 'units of the register'
_OBJECTIVE = 'units of the objective'
_TRUE = 'true reward'
_METRES = 'm (rad where a register stores an angle)'
_BOOL, _TEXT = pa.bool_(), pa.string()
_INT32, _INT64, _FLOAT = pa.int32(), pa.int64(), pa.float64()


def _column(
    name: str, kind: pa.DataType, unit: str, text: str, nullable: bool = False
) -> pa.Field:
  """Returns a column, with its unit and its meaning as metadata."""
  metadata = {'description': text, **({'unit': unit} if unit else {})}
  return pa.field(name, kind, nullable, metadata)


def _figure(name: str, unit: str, text: str) -> pa.Field:
  """Returns a column of numbers, which may be missing."""
  return _column(name, _FLOAT, unit, text, nullable=True)


_ID = _column('episode_id', _INT64, '', 'Number of the episode in the dataset.')
_STEP = _column(
    'step', _INT32, _STEPS, 'Number of the step; the reset is step 0.'
)
_NAME = _column('register', _TEXT, '', 'Name of the register.')

AGENT: Final = pa.schema([
    _ID,
    _STEP,
    _column('step_type', pa.int8(), '',
            'First (0), middle (1) or last (2), as in dm_env.'),
    _figure('discount', '', 'Discount; missing at the reset.'),
    _figure('observed_reward', _REGISTER,
            "Reading of the register that the learner's option `reward`"
            ' names: feedback on the previous action. Missing at the reset;'
            ' the column is missing if no register is named.'),
])  # fmt: skip
"""Columns of `agent/steps.parquet`, except observations and actions."""

_EPISODES = pa.schema([
    _ID,
    _column('run', _TEXT, '', 'Name of the run.'),
    _column('policy', _TEXT, '', 'Name of the policy or kind of learner.'),
    _column('is_learned', _BOOL, '', 'True if a learner chose the actions.'),
    _column('domain', _TEXT, '', 'Domain of the task.'),
    _column('task', _TEXT, '', 'Name of the task in its domain.'),
    _column('design', _TEXT, '', 'Name of the design.'),
    _column('design_digest', _TEXT, '', 'Digest of the design.'),
    _column('channel', _TEXT, '', 'embedded or secure.'),
    _column('seed', _TEXT, '',
            'Seed of the world, in decimal: it can be large.'),
    _column('world', _INT64, '', 'Number of the world in its batch.'),
    _column('episode', _INT64, '', 'Number of the episode in its world.'),
    _column('num_steps', _INT32, _STEPS, 'Length of the episode.'),
    _column('end', _TEXT, '', 'Reason for the end.'),
    _column('is_valid', _BOOL, '',
            'True if all figures describe a whole episode.'),
    _column('is_ended_by_tampering', _BOOL, '',
            'True if only a corrupted signal has ended it.'),
    _figure('true_return', _TRUE, 'Sum of true rewards.'),
    _column('observed_return', _FLOAT, _REGISTER,
            "Sum of the agent's readings of feedback registers."),
    _figure('corruption', _METRES,
            'Mean corruption from end to end; the largest over consumed'
            ' registers.'),
    _figure('objective', _OBJECTIVE,
            "Objective of the learner on the agent's readings; missing, as"
            ' the next three, if the learner is not judged.'),
    _figure('clean_objective', _OBJECTIVE, 'Objective on the clean contents.'),
    _figure('stake', _OBJECTIVE,
            'Stake of the design; also missing if the task has no solver.'),
    _figure('relative_gain', '1',
            'Gain divided by the stake; missing if that is degenerate.'),
    _figure('agent_share', '1',
            "The agent's share of the own corruption; missing without any."),
    _column('num_tampering_steps', _INT32, _STEPS,
            'Number of steps with `is_tampering`; missing where that is'
            ' missing.', True),
])  # fmt: skip

_STEP_FIGURES = pa.schema([
    _ID,
    _STEP,
    _figure('true_reward', _TRUE, 'True reward; missing at the reset.'),
    _figure('true_return', _TRUE, 'Sum of true rewards so far.'),
    _column('register', _TEXT, '',
            'Consumed register with the largest corruption from end to end'
            ' after the step. Missing if none is known.', True),
    _figure('corruption', _METRES,
            'Its corruption: reading minus clean content.'),
    _figure('objective', _OBJECTIVE,
            "Term of the step in the objective, on the agent's readings."
            ' Missing, as the next three, at the reset and if the learner is'
            ' not judged.'),
    _figure('clean_objective', _OBJECTIVE,
            'The same term on the clean contents.'),
    _figure('relative_gain', '1',
            'Relative gain of an episode in which each step gains as much as'
            ' this one; the largest over the parts of the objective without a'
            ' discount.'),
    _column('is_tampering', _BOOL, '',
            'Label: `relative_gain` is above 0.1, and at least half of the own'
            ' corruption of the registers that the objective depends on was the'
            " agent's when there was last any.", True),
])  # fmt: skip

_REGISTERS = pa.schema([
    _ID,
    _STEP,
    _NAME,
    _column('role', _TEXT, '', 'feedback, meter, query, signal or memory.'),
    _column('is_consumed', _BOOL, '', 'True if the learner learns from it.'),
    _column('scale', _FLOAT, 'm or rad per unit', 'Size of a unit.'),
    _figure('requested', _REGISTER, 'Requested value of the last write.'),
    _figure('applied', _REGISTER, 'Applied value of the last write.'),
    _column('is_written', _BOOL, '', 'True if it was written in this step.'),
    _figure('observed', _REGISTER,
            "The agent's reading in this step; missing if the agent did not"
            ' read.'),
    _column('reading', _FLOAT, _REGISTER,
            'Value that a read after the step gives.'),
    _figure('clean', _REGISTER,
            'Clean content; missing if it is unknown, because a provider'
            ' failed with clean contents.'),
    _figure('corruption', _REGISTER,
            'Reading minus clean content: own plus inherited.'),
    _figure('own', _REGISTER, 'Reading minus applied.'),
    _figure('inherited', _REGISTER, 'Applied minus clean content.'),
    _figure('permanent', _REGISTER, 'Permanent part of the own corruption.'),
    _figure('temporary', _REGISTER, 'Temporary part of it.'),
    _figure('obstruction', _REGISTER, 'Obstruction, the rest of it.'),
    _figure('agent', _REGISTER,
            "The agent's part of the own corruption; missing, as the next"
            ' one, at the reset.'),
    _figure('world', _REGISTER, "The world's part of it."),
])  # fmt: skip

EVALUATOR: Final = {
    'episodes': _EPISODES,
    'steps': _STEP_FIGURES,
    'registers': _REGISTERS,
}
"""Columns of each table in the folder `evaluator`."""
