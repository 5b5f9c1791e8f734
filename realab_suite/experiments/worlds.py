"""Worlds that are loaded by name, and what designs are worth in them."""

from collections.abc import Mapping
import contextlib
import dataclasses
import functools
import pathlib
from typing import Any, final

from realab_suite import policies
from realab_suite import suite
from realab_suite.engine import batch_environment
from realab_suite.engine import environment
from realab_suite.evaluation import stakes
from realab_suite.experiments import storage
from realab_suite.feedback import specs
from realab_suite.tasks import base

STAKES = 'stakes'
"""Folder of the stakes in the folder of an experiment."""


@final
@dataclasses.dataclass(frozen=True)
class World:
  """A world and the settings with which it is loaded.

  Attributes:
    domain: Name of the domain.
    task: Name of the task in it.
    max_steps: Maximum length of an episode in control steps.
    task_kwargs: Arguments of the task, without the seed.
    senses: Names of the agent's senses; `None` for the default ones.
  """

  domain: str
  task: str
  max_steps: int = suite.MAX_STEPS
  task_kwargs: Mapping[str, Any] = dataclasses.field(default_factory=dict)
  senses: tuple[str, ...] | None = None

  def load(
      self, design: specs.DesignSpec, seed: int, world: int = 0
  ) -> environment.Environment:
    """Returns one world with a design.

    Args:
      design: The design.
      seed: Seed of its random streams.
      world: Number of the world in a batch.
    """
    return suite.load(
        self.domain,
        self.task,
        {**self.task_kwargs, 'random': seed},
        {'max_steps': self.max_steps, 'senses': self.senses, 'world': world},
        design=design,
    )

  def load_batch(
      self,
      design: specs.DesignSpec,
      num_envs: int,
      seed: int,
      *,
      sleep: bool = False,
  ) -> batch_environment.BatchEnvironment:
    """Returns a batch of worlds with a design, stepped by one thread.

    Args:
      design: The design.
      num_envs: Number of worlds.
      seed: Seed of their random streams.
      sleep: True if blocks at rest fall asleep; see `suite.load_batch`.
    """
    return suite.load_batch(
        self.domain,
        self.task,
        {**self.task_kwargs, 'random': seed},
        {'max_steps': self.max_steps, 'senses': self.senses},
        num_envs=num_envs,
        num_threads=1,
        sleep=sleep,
        design=design,
    )

  @functools.cached_property
  def solver(self) -> str | None:
    """Name of the policy that solves the task, or `None`."""
    return self._example.SOLVER

  @property
  def instruments(self) -> frozenset[str]:
    """Senses that show the registers' blocks, or that blocks can cover."""
    return self._example.INSTRUMENTS

  @property
  def reference(self) -> 'World':
    """World in which stakes are measured."""
    return dataclasses.replace(self, task=self._example.REFERENCE)

  @functools.cached_property
  def _example(self) -> base.Task:
    with contextlib.closing(self.load(specs.load('none'), 0)) as env:
      task: base.Task = env.task
      return task


def stakes_of(
    world: World, design: specs.DesignSpec, folder: pathlib.Path | None = None
) -> stakes.Stakes | None:
  """Returns the stakes of a design in the domain of a world.

  Args:
    world: The world.
    design: The design.
    folder: Folder of an experiment, in which stakes are kept under their keys;
      `None` to measure them.

  Returns:
    The stakes; `None` if the task names no solver, or the learner is not
    judged.
  """
  if design.objective is None or world.solver is None:
    return None
  reference = world.reference
  if reference.senses is not None:
    # The agent's senses are not those that the solver needs.
    senses = [*policies.make(world.solver).required_senses]
    for provider in design.providers:
      senses += provider.required_senses
    reference = dataclasses.replace(
        reference, senses=tuple(dict.fromkeys(senses))
    )
  key = stakes.key_of(
      design,
      solver=world.solver,
      world=dataclasses.asdict(reference),
      dynamics=suite.dynamics(reference.domain, reference.task),
  )
  path = None if folder is None else folder / STAKES / f'{key}.json'
  if path is not None and path.exists():
    found = stakes.Stakes.model_validate(storage.read_json(path))
    if found.key == key:
      return found
  found = stakes.measure(reference.load_batch, design, world.solver, key)
  if path is not None:
    path.parent.mkdir(parents=True, exist_ok=True)
    storage.write_json(path, found.model_dump())
  return found


def why_no_stakes(world: World, design: specs.DesignSpec) -> str:
  """Returns the reason for missing stakes, or an empty string."""
  if design.objective is None:
    return design.why_not_judged
  if world.solver is None:
    return (
        f'{world.domain}.{world.task} names no solver, so the design has no'
        ' stake'
    )
  return ''
