from collections.abc import Callable
from typing import Any

import numpy as np

class Observable:
  enabled: bool
  update_interval: Any
  buffer_size: Any
  delay: Any
  aggregator: Any
  corruptor: Any
  @property
  def array_spec(self) -> Any: ...
  def __call__(
      self, physics: Any, random_state: np.random.RandomState | None = None
  ) -> Any: ...
  def configure(self, **kwargs: Any) -> None: ...

class Generic(Observable):
  def __init__(
      self, raw_observation_callable: Callable[[Any], Any], **kwargs: Any
  ) -> None: ...

class MJCFCamera(Observable):
  height: int
  width: int
  def __init__(
      self,
      mjcf_element: Any,
      height: int = ...,
      width: int = ...,
      **kwargs: Any,
  ) -> None: ...
