"""The command `jaxmpc`, with its options, problem files and plots."""
