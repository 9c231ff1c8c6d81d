"""The options of each command of `jaxmpc`: names, values and help, to be parsed without JAX."""
