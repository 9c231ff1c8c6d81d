"""The commands of `jaxmpc`: from options to calls of the library, and from results to files."""
