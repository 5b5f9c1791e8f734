"""Worlds that are loaded by name."""

from collections.abc import Mapping, Sequence
import contextlib
import dataclasses
import functools
from typing import Any, final

from realab_suite import policies
from realab_suite import suite
from realab_suite.engine import batch_environment
from realab_suite.engine import environment
from realab_suite.feedback import specs
from realab_suite.policies import action_sets
from realab_suite.tasks import base
from realab_suite.tasks import registry


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

  def fitted(
      self, design: specs.DesignSpec, *others: 'World'
  ) -> specs.DesignSpec:
    """Returns a design with the ranges that it has in this world.

    Args:
      design: The design.
      *others: Further worlds that it is to fit.
    """
    return design.fitted(*(one._measured_ranges for one in (self, *others)))

  @property
  def _measured_ranges(self) -> Mapping[str, tuple[float, float]]:
    if self.task_kwargs:
      task = suite.make_task(self.domain, self.task, self.task_kwargs)
    else:
      task = _task(self.domain, self.task)
    return getattr(task, 'measured_ranges', {})

  @property
  def solver(self) -> str | None:
    """Name of the policy that solves the task, or `None`."""
    return _task(self.domain, self.task).SOLVER

  def control_of(self, names: Sequence[str]) -> str:
    """Returns the control among scripted policies.

    It is the solver, else the first that is no saboteur of the task, else the
    first.

    Args:
      names: Names of the policies; `solver` stands for that of the task.
    """
    solver = policies.base.SOLVER, self.solver
    solvers = [name for name in names if name in solver]
    others = [name for name in names if name not in self.saboteurs]
    return [*solvers, *others, *names][0]

  @property
  def best_mean_return(self) -> float:
    """Mean true return of episodes that are played as well as possible."""
    return _task(self.domain, self.task).best_mean_return

  @property
  def saboteurs(self) -> tuple[str, ...]:
    """Names of policies that move the registers' blocks."""
    return tuple(_task(self.domain, self.task).SABOTEURS)

  def scripted_in(self, design: specs.DesignSpec) -> tuple[str, ...]:
    """Returns names of policies to compare in a design.

    They are the solver, a saboteur, and random actions. Where no register has
    blocks, the saboteur is the world's own, which stands last.
    """
    solver = () if self.solver is None else (self.solver,)
    registers = design.registers.values()
    has_blocks = any(spec.register_class.HAS_BLOCKS for spec in registers)
    saboteurs = self.saboteurs[:1] if has_blocks else self.saboteurs[-1:]
    return (*solver, *saboteurs, 'random')

  @property
  def action_set(self) -> action_sets.ActionSet:
    """Actions of people, and of policies that act in any world."""
    return _task(self.domain, self.task).ACTION_SET

  @property
  def instruments(self) -> frozenset[str]:
    """Senses that show the registers' blocks, or that blocks can cover."""
    return frozenset(_task(self.domain, self.task).INSTRUMENTS)

  @property
  def reference(self) -> str:
    """Name of the task in which the stakes of designs are measured."""
    return _task(self.domain, self.task).REFERENCE

  def for_stakes(self, design: specs.DesignSpec, task: str) -> 'World':
    """Returns a world in which the stakes of a design are measured.

    Its senses are those that the solver and the providers need, because the
    senses of the agent do not change what readings are worth.

    Args:
      design: The design.
      task: Name of the task in the domain.
    """
    needed = [
        one.required_senses
        for one in design.in_world(self.solver).providers
        if one.senses != 'own'
    ]
    if self.solver is not None:
      needed.append(policies.make(self.solver).required_senses)
    senses = {name for names in needed for name in names}
    return dataclasses.replace(self, task=task, senses=tuple(sorted(senses)))


def _task(domain: str, task: str) -> base.Task:
  """Returns a task, whose attributes designs are judged by."""
  return _made(registry.find(domain, task), domain, task)


@functools.cache
def _made(factory: registry.TaskFactory, domain: str, task: str) -> base.Task:
  """Returns a task; `factory` may be registered again, as another class."""
  del factory
  with contextlib.closing(suite.load(domain, task, design=None)) as env:
    return env.task
