"""The command `jaxmpc`, and what only it needs: options, problem files, pictures."""
