"""The environment designer's side: worlds with a hidden true reward."""
