"""Feedback providers as entities, in a mechanism or by themselves."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, final

from dm_control import composer
from dm_control import mjcf
import numpy as np

from realab_suite import errors
from realab_suite.config import messages
from realab_suite.config import validation
from realab_suite.entities import meters
from realab_suite.entities import modelled
from realab_suite.entities.registers import base
from realab_suite.entities.registers import ports
from realab_suite.feedback import clean_contents
from realab_suite.feedback import composer_hooks
from realab_suite.feedback import providers
from realab_suite.feedback import register_writes
from realab_suite.feedback import specs


@final
class FeedbackProvider(modelled.ModelledEntity):
  """A feedback provider with its registers.

  It has an observable for each register that it writes, which is disabled by
  default: `written_` and the name of the register, with the applied value of
  the last write. A silent provider writes nothing, so that value stands.

  A mechanism decides when its providers act. A provider that is attached by
  itself, as in `arena.attach(provider)`, acts at the end of each control step
  of `composer.Environment`, after the task and after all meters that are
  attached by themselves, in whatever order. Several providers act in the order
  of attachment. Its state and its random key, which is drawn from the random
  state of the environment, begin anew with each episode.

  Attributes:
    title: Name of the provider in records, such as `providers[0]:difference`.
    spec: Specification and pure function of the provider.
    reads: Ports that the provider reads, in the order of the design.
    targets: Registers that the provider may write.
    seen: Keys of the observation that the provider gets.
    is_secure: True if it writes secure registers only. It then senses without
      obstruction, as meters of such registers measure.
  """

  def _build(
      self,
      spec: Any,
      reads: Sequence[ports.AnyPort],
      writes: Sequence[base.Register],
      *,
      title: str = '',
      mjcf_model: mjcf.RootElement | None = None,
      read_by_agent: Sequence[str] = (),
  ) -> None:
    """Connects a provider to registers.

    Args:
      spec: Kind and options, as in `{'kind': 'difference', 'initial': 1.0}`; or
        the name of a kind that needs no options; in a mechanism, the provider.
      reads: Registers that it reads, or ports of them, in the order that the
        kind expects.
      writes: Registers that it writes, in the order that the kind expects.
      title: Name of the provider in records of a mechanism.
      mjcf_model: Model of the mechanism, because a provider has no body; `None`
        for a model of its own, which can be attached.
      read_by_agent: Names of the ports of the mechanism whose readings the
        agent observes. A provider by itself gets those of `reads` and `writes`.

    Raises:
      SpecError: If a provider by itself does not fit its registers, or needs
        what Composer does not pass to entities.
    """
    design: specs.DesignSpec | None = None
    if mjcf_model is None:
      design = _design_of(spec, reads, writes)
      [spec] = design.providers
      name = '_'.join(['provider', *(register.name for register in writes)])
      title = f'{name}:{spec.kind}'
      mjcf_model = mjcf.RootElement(model=name)
      read_by_agent = design.names(*specs.READ_BY_AGENTS)
    self.title = title
    self.spec: providers.Provider = spec
    self._mjcf_root = mjcf_model
    self.reads = _ports_of(reads)
    self.targets = [
        register_writes.Target(
            register,
            ports.of(register),
            [port.name for port in ports.of(register)],
            (),
        )
        for register in writes
    ]
    self.is_secure = all(
        target.register.channel == 'secure' for target in self.targets
    )
    self.seen = [
        *(f'senses/{name}' for name in spec.required_senses),
        *(f'privileged/{name}' for name in spec.privileged_senses),
        *(f'registers/{name}' for name in read_by_agent),
    ]
    self._privileged = [f'privileged/{name}' for name in spec.privileged_senses]
    self._hooks = design and composer_hooks.ProviderHooks(self, design)

  def iter_entities(
      self, exclude_self: bool = False
  ) -> Iterator[composer.Entity]:
    """Yields the provider, and its hooks if it is in no mechanism."""
    yield from super().iter_entities(exclude_self)
    if self._hooks is not None:
      yield self._hooks

  def _build_observables(self) -> composer.Observables:
    observables = super()._build_observables()
    for target in self.targets:
      observables.add_observable(
          f'written_{target.register.name}',
          meters.Unseen(target.register.applied),
          enabled=False,
      )
    return observables

  def see(
      self, observation: providers.Observation
  ) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Returns the part of an observation that the provider gets, by key.

    Args:
      observation: Observation that the agent's action responds to, with what
        providers alone sense.

    Returns:
      The senses and readings, and the ideal measurements of the senses that
      something can obstruct.
    """
    ideal = {}
    for key in self._privileged:
      if clean_contents.IDEAL + key in observation:
        ideal[key] = observation[clean_contents.IDEAL + key]
    return {key: observation[key] for key in self.seen}, ideal


def _ports_of(registers: Sequence[ports.AnyPort]) -> list[ports.AnyPort]:
  """Returns the ports of registers, some of which may be ports themselves."""
  all_ports: list[ports.AnyPort] = []
  for one in registers:
    all_ports += ports.of(one) if isinstance(one, base.Register) else [one]
  return all_ports


def _design_of(
    spec: Any, reads: Sequence[ports.AnyPort], writes: Sequence[base.Register]
) -> specs.DesignSpec:
  """Returns the design of a provider by itself, with all checks of designs.

  Each port is a register of its own in this design.

  Raises:
    SpecError: If the provider does not fit its registers.
  """
  where = 'FeedbackProvider'
  for name, given, kinds in (
      ('reads', reads, ports.AnyPort),
      ('writes', writes, base.Register),
  ):
    if not isinstance(given, list | tuple) or not all(
        isinstance(one, kinds) for one in given
    ):
      raise errors.SpecError(
          f'{where}: {name}: {messages.quote(given)}; must be a list of'
          ' registers, as [registers.TwoBlockRegister(...)]'
      )
  if isinstance(spec, str):
    spec = {'kind': spec}
  if (
      not isinstance(spec, Mapping)
      or not isinstance(spec.get('kind'), str)
      or spec.keys() & {'reads', 'writes'}
  ):
    raise errors.SpecError(
        f'{where}: {messages.quote(spec)}; must be a kind, or a mapping with'
        ' kind and options, without the names of registers'
    )
  read, written = _ports_of(reads), _ports_of(writes)
  names = {
      'reads': [port.name for port in read],
      'writes': [port.name for port in written],
  }
  kind = providers.PROVIDERS.get(spec['kind'])
  provider = validation.validate(kind, {**spec, **names}, where)
  title = f'{where}: {provider.kind!r}'
  composer_hooks.refuse(title, composer_hooks.needs_of(provider))
  data = {
      'schema': 1,
      'name': 'alone',
      'registers': {
          port.name: {
              'kind': 'two_block',
              'role': port.role,
              'place': [0, 0],
              'range': port.value_range,
              'scale': port.scale,
              'initial': port.initial,
          }
          for port in [*read, *written]
      },
      'providers': [provider],
  }
  return validation.validate(specs.DesignSpec, data, where).in_world(None)
