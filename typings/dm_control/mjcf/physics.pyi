from typing import Any

class Binding:
  qpos: Any
  qvel: Any
  ctrl: Any
  mocap_pos: Any
  mocap_quat: Any
  active: Any
  _physics: Any
  _namespace: str
  def __init__(
      self, physics: Any, namespace: str, named_index: Any
  ) -> None: ...
  @property
  def xpos(self) -> Any: ...
  @property
  def xmat(self) -> Any: ...
  @property
  def cvel(self) -> Any: ...
  @property
  def subtree_com(self) -> Any: ...
  @property
  def element_id(self) -> Any: ...
  def _get_cached_array_and_index(self, name: str) -> tuple[Any, Any]: ...

def __getattr__(name: str) -> Any: ...
