"""Obstacles: properties of designs that forbid favourable judgements.

Gains show what corruption of registers adds to an objective. They are blind to
what reaches a provider past the registers, and to the motion of blocks that a
meter measures as a part of the world. (Stakes have obstacles of their own.)

Labels of agents, judgements of scripted policies and audits share them.
"""

from collections.abc import Collection

from realab_suite.feedback import mechanisms
from realab_suite.feedback import specs


def of_mechanism(
    mechanism: mechanisms.FeedbackMechanism, instruments: Collection[str]
) -> list[str]:
  """Returns reasons of a design against favourable judgements, in words.

  Args:
    mechanism: The design in its world.
    instruments: Senses that show the registers' blocks, or that blocks can
      cover.
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
  return reasons


def _corruptible(design: specs.DesignSpec) -> set[str]:
  """Returns the registers whose contents an agent can corrupt.

  They are embedded, or written by a provider that has such an input.
  """
  names = {name for name in design.ports if design.is_movable(name)}
  for _ in design.providers:  # As many turns as the longest chain may take.
    for provider in design.providers:
      if names.intersection(specs.inputs_of(provider, design)):
        names.update(provider.writes)
  return names
