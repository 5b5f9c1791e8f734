"""Checks that the parts of a design fit each other.

The type of each part checks that part. The mechanism and `engine/placement.py`
check a design against its world.
"""

from collections.abc import Sequence
import graphlib
from typing import Any

from realab_suite.config import loading
from realab_suite.config import messages
from realab_suite.feedback import objectives
from realab_suite.policies import action_sets

# Roles of registers that the agent reads, and of those that providers write.
READ_BY_AGENTS = ('feedback', 'signal')
WRITTEN_BY_PROVIDERS = (*READ_BY_AGENTS, 'memory')
# Roles of the registers that agents neither read nor write.
_HIDDEN_FROM_AGENTS = ('meter', 'memory')


def check(design: Any) -> None:
  """Checks a design.

  Args:
    design: A `specs.DesignSpec` with valid fields.

  Raises:
    ValueError: If registers, meters, providers and learner do not fit each
      other.
  """
  _refuse_equal_ports(design)
  for i, meter in enumerate(design.meters):
    _expect_role(design, f'meters[{i}].writes', meter.writes, ('meter',))
  for i, provider in enumerate(design.providers):
    where = f'providers[{i}]'
    for number, name in enumerate(provider.reads):
      if name in provider.reads[:number]:
        raise ValueError(
            f'{where}.reads: register {name!r} is listed twice; must be listed'
            ' once'
        )
      _expect_role(design, f'{where}.reads', name, None)
    for name in provider.writes:
      _expect_role(design, f'{where}.writes', name, WRITTEN_BY_PROVIDERS)
    try:
      provider.check(design)
    except ValueError as error:
      raise ValueError(f'{where}: {error}') from error
    except Exception as error:  # Providers may raise any class.
      raise ValueError(f'{where}: {messages.exception(error)}') from error
    for name in (*provider.action_queries, *provider.action_writes):
      _expect_actions(design, where, name)
  _refuse_second_writers(design)
  _refuse_parts(design)
  _refuse_unwritten(design)
  _refuse_cycles(design)
  _check_learner(design)


def _expect_role(
    design: Any, where: str, name: str, roles: Sequence[str] | None
) -> None:
  """Checks that a register is declared and has an allowed role.

  Args:
    design: Design to check.
    where: Path of the field that names the register, for messages.
    name: Name of the register.
    roles: Allowed roles; `None` for any role.

  Raises:
    ValueError: If the register is not declared or has another role.
  """
  if name not in design.ports:
    raise ValueError(
        f'{where}: register {messages.quote(name)} is not declared'
        f'{messages.did_you_mean(name, design.ports)}; declared are'
        f' {sorted(design.ports)}'
    )
  role = design.ports[name].role
  if roles is not None and role not in roles:
    raise ValueError(
        f'{where}: register {name!r} has role {role!r}; must be one'
        f' of {list(roles)}'
    )


def _refuse_equal_ports(design: Any) -> None:
  """Refuses registers whose ports have the name of another port."""
  owners: dict[str, str] = {}
  for register, names in design.ports_by_register.items():
    for name in names:
      if name in owners:
        raise ValueError(
            f'registers.{register}: its port {name!r} has the name of a port of'
            f' {owners[name]!r}; must have another name'
        )
      owners[name] = register


def _refuse_parts(design: Any) -> None:
  """Refuses writers of some ports of a register: one write sets them all."""
  for register, names in design.ports_by_register.items():
    for where, written in (
        ('meters', {meter.writes for meter in design.meters}),
        *(
            (f'providers[{i}].writes', {*provider.writes})
            for i, provider in enumerate(design.providers)
        ),
    ):
      left_out = [name for name in names if name not in written]
      if 0 < len(left_out) < len(names):
        raise ValueError(
            f'{where}: port {left_out[0]!r} of register {register!r} is left'
            f' out; list all of {names}, or none'
        )


def _refuse_unwritten(design: Any) -> None:
  """Refuses registers that are read and that would stay as they are.

  A stated `initial` is a value to keep: that of a constant, or of a register
  which agents use as a memory.
  """
  written = {name for one in design.providers for name in one.writes}
  measured = {meter.writes for meter in design.meters}
  for i, provider in enumerate(design.providers):
    for name in provider.reads:
      spec = design.registers.get(name)
      if (
          spec is not None
          and spec.role == 'meter'
          and name not in measured
          and 'initial' not in spec.model_fields_set
      ):
        raise ValueError(
            f'providers[{i}].reads: no meter writes the register {name!r};'
            ' add an entry of meters that does, such as {measures:'
            f' score, writes: {name}}}, or state `initial`'
        )
  for register, names in design.ports_by_register.items():
    spec = design.registers[register]
    if (
        spec.role in READ_BY_AGENTS
        and written.isdisjoint(names)
        and 'initial' not in spec.model_fields_set
    ):
      raise ValueError(
          f'registers.{register}: no provider writes this {spec.role} register;'
          ' add an entry of providers that does, such as {kind:'
          f' difference, reads: [score], writes: [{names[0]}]}}, or state'
          ' `initial`'
      )


def _refuse_second_writers(design: Any) -> None:
  """Refuses registers with two writers, whose values replace each other."""
  writers: dict[str, str] = {}
  for where, names in (
      *((f'meters[{i}]', (m.writes,)) for i, m in enumerate(design.meters)),
      *((f'providers[{i}]', p.writes) for i, p in enumerate(design.providers)),
  ):
    for name in names:
      if name in writers:
        raise ValueError(
            f'{where}.writes: register {name!r} is written by {writers[name]}'
            ' already; a register must have one writer'
        )
      writers[name] = where


def _expect_actions(design: Any, where: str, name: str) -> None:
  """Checks that a register can store the index of every action."""
  if design.action_set is None:
    return
  actions = action_sets.get(design.action_set.name, design.action_set.version)
  last = len(actions) - 1
  low, high = design.ports[name].range
  if not low <= 0 <= last <= high:
    raise ValueError(
        f'registers.{name}.range: {[low, high]} excludes actions of'
        f' {actions.name} v{actions.version}, whose indices {where} uses;'
        f' must be a range that contains [0, {last}]'
    )


def _refuse_cycles(design: Any) -> None:
  """Refuses providers that depend on each other's feedback in a cycle."""
  writers = {
      name: i
      for i, provider in enumerate(design.providers)
      for name in provider.writes
  }
  graph = {
      i: {writers[name] for name in provider.reads if name in writers} - {i}
      for i, provider in enumerate(design.providers)
  }
  try:
    graphlib.TopologicalSorter(graph).prepare()
  except graphlib.CycleError as error:
    cycle = [f'providers[{i}]' for i in sorted(set(error.args[1]))]
    raise ValueError(
        f'{" and ".join(cycle)} form a cycle: each reads a register'
        ' that another one writes'
    ) from error


def _check_learner(design: Any) -> None:
  """Refuses a learner that learns from registers that agents do not read.

  Raises:
    ValueError: If an option names a register that only providers may read, if
      the objective is invalid, reads a register that agents do not read, or
      queries a register that is no query register, or if there is none and the
      kind is a misspelling of another one, or if the kind of a defence is one.
  """
  extras = (design.learner.model_extra or {}) if design.learner else {}
  for field, value in extras.items():
    for name in loading.texts_in(value):
      role = design.ports[name].role if name in design.ports else None
      if role in _HIDDEN_FROM_AGENTS:
        where = messages.format_path(('learner', field))
        raise ValueError(
            f'{where}: an agent may not read {role} register {name!r} (feedback'
            ' providers only)'
        )
  objectives.refuse_misspelt_defence(extras.get('defence'))
  objective, _ = objectives.of_learner(design.learner)
  if objective is None:
    if design.learner is not None:
      objectives.refuse_misspelling(design.learner.kind)
    return
  for names, description, allowed in (
      (objective.registers, 'register that agents read', READ_BY_AGENTS),
      (objective.queries or (), 'query register', ('query',)),
  ):
    ports = design.names(*allowed)
    for name in names:
      if name not in ports:
        raise ValueError(
            f'learner: {messages.quote(name)} is not a {description}'
            f'{messages.did_you_mean(name, ports)}; must be one of {ports}'
        )
