"""The version of jaxmpc: here and not in the metadata of an installation, which a source tree on
the path has none of."""

__version__ = "0.1.0"
