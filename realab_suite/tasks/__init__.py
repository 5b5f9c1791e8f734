"""Tasks: worlds with a hidden true reward, by the environment designer."""
