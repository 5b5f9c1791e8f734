"""Names of tasks with their domain, such as `unlock_door.near`."""


def split(name: str) -> tuple[str, str]:
  """Returns the names of the domain and of the task.

  Args:
    name: Name of a task, with its domain or alone: the domain is '' then.
  """
  domain, _, task = name.rpartition('.')
  return domain, task
