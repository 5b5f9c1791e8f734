"""Feedback providers as entities of a mechanism."""

from collections.abc import Sequence
from typing import final

from dm_control import mjcf
import numpy as np

from realab_suite.entities import modelled
from realab_suite.entities.registers import ports
from realab_suite.feedback import clean_contents
from realab_suite.feedback import providers
from realab_suite.feedback import register_writes


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
      targets: Sequence[register_writes.Target],
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
    self.is_secure = all(
        target.register.channel == 'secure' for target in targets
    )
    self.seen = [
        *(f'senses/{name}' for name in spec.required_senses),
        *(f'privileged/{name}' for name in spec.privileged_senses),
        *(f'registers/{name}' for name in read_by_agent),
    ]
    self._privileged = [f'privileged/{name}' for name in spec.privileged_senses]

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
