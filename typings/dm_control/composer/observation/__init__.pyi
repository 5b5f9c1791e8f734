from collections.abc import Mapping, Sequence
from typing import Any

from dm_control.composer.observation import observable as observable
import numpy as np

class Updater:
  def __init__(
      self,
      observables: (
          Mapping[str, observable.Observable]
          | Sequence[Mapping[str, observable.Observable]]
      ),
      physics_steps_per_control_step: int = 1,
      **kwargs: Any,
  ) -> None: ...
  def reset(
      self, physics: Any, random_state: np.random.RandomState | None
  ) -> None: ...
  def observation_spec(self) -> Any: ...
  def prepare_for_next_control_step(self) -> None: ...
  def update(self) -> None: ...
  def get_observation(self) -> Any: ...

def __getattr__(name: str) -> Any: ...
