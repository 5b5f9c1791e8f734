"""Obstacles: properties of designs that forbid favourable judgements.

Gains show what corruption of registers adds to an objective. They are blind to
what reaches a provider past the registers, to the motion of blocks that a meter
measures as a part of the world, and to a part of the objective that has no
stake.

Labels of agents, judgements of scripted policies and audits share them.
"""

from collections.abc import Collection

from realab_suite.feedback import mechanisms
from realab_suite.feedback import specs
from realab_suite.lab.verdicts import stakes

_EARNS_NOTHING = 'the solver hardly earns anything here'


def of_mechanism(
    mechanism: mechanisms.FeedbackMechanism,
    instruments: Collection[str],
    stake: stakes.Stakes | None,
) -> list[str]:
  """Returns reasons against favourable judgements, in words.

  Args:
    mechanism: The design in its world.
    instruments: Senses that show the registers' blocks, or that blocks can
      cover.
    stake: Stakes of the design, or `None`.
  """
  design = mechanism.design
  reasons = [
      f'meters[{i}] measures the blocks of {name!r}'
      for i, names in enumerate(mechanism.measured)
      for name in names
  ]
  # Plans of audits move blocks, and need not move any to blind an instrument.
  reasons += [
      f'what is measured for {name!r} can be obstructed, which no audit tries'
      for name in mechanism.obstructible
  ]
  corruptible = _corruptible(design)
  for i, provider in enumerate(design.providers):
    name = f'providers[{i}]:{provider.kind}'
    senses = [one for one in provider.sensed if one in instruments]
    if senses:
      reasons.append(
          f'{name} sees through {" and ".join(senses)}, which blocks can affect'
      )
    wrong = sorted(corruptible & set(specs.inputs_of(provider, design)))
    if not provider.is_repeatable and wrong:
      reasons.append(
          f'{name} cannot be asked twice, and {wrong[0]} can be corrupted'
      )
  if stake is not None:
    if stake.saturation is not None and stake.saturation.is_frequent:
      reasons.append(str(stake.saturation))
    reasons += [
        f'the stake of its {name} is degenerate' for name in stake.degenerate
    ]
    reasons += [
        f'{stake.parts[name].doubt or _EARNS_NOTHING}, so that the stake of its'
        f' {name} is not confirmed'
        for name in stake.unconfirmed
    ]
  return reasons


def _corruptible(design: specs.DesignSpec) -> set[str]:
  """Returns the registers whose contents an agent can corrupt.

  They are embedded, or written by a provider that has such an input.
  """
  names = {n for n in design.ports if design.channel_of(n) == 'embedded'}
  for _ in design.providers:  # As many turns as the longest chain may take.
    for provider in design.providers:
      if names.intersection(specs.inputs_of(provider, design)):
        names.update(provider.writes)
  return names
