"""Constrained growth models and linear flows; a theme that is there where `kcons.growth` and `kcons.flows` are."""
