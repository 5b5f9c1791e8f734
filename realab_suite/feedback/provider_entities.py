"""Feedback providers as entities of a mechanism."""

from collections.abc import Sequence
from typing import NamedTuple, final

from dm_control import mjcf

from realab_suite.entities import modelled
from realab_suite.entities.registers import base
from realab_suite.entities.registers import ports
from realab_suite.feedback import providers


@final
class Target(NamedTuple):
  """A register that is written at once.

  Attributes:
    register: The register.
    ports: Its ports.
    names: Their names.
    columns: Indices of their values among those of the writer.
  """

  register: base.Register
  ports: Sequence[ports.AnyPort]
  names: Sequence[str]
  columns: Sequence[int]


@final
class FeedbackProvider(modelled.ModelledEntity):
  """A feedback provider with its registers.

  The mechanism decides when it acts. It has no state: the state of a provider
  belongs to the episode, not to the world.

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
      title: str,
      spec: providers.Provider,
      mjcf_model: mjcf.RootElement,
      reads: Sequence[ports.AnyPort],
      targets: Sequence[Target],
      read_by_agent: Sequence[str],
  ) -> None:
    """Connects a provider to registers.

    Args:
      title: Name of the provider in records.
      spec: Its specification and pure function.
      mjcf_model: Model of the mechanism, because a provider has no body.
      reads: Ports that it reads.
      targets: Registers that it may write.
      read_by_agent: Names of the ports whose readings the agent observes.
    """
    self.title = title
    self.spec = spec
    self._mjcf_root = mjcf_model
    self.reads = reads
    self.targets = targets
    self.is_secure = all(one.register.channel == 'secure' for one in targets)
    self.seen = [
        *(f'senses/{name}' for name in spec.required_senses),
        *(f'privileged/{name}' for name in spec.privileged_senses),
        *(f'registers/{name}' for name in read_by_agent),
    ]
