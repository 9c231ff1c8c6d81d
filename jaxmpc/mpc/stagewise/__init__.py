"""Plans stage by stage along the horizon, for systems that vary and for nonlinear models."""
