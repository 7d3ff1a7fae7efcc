"""One file per parametric bone: its named parameters and the solid they make."""
