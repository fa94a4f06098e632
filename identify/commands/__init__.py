"""Subcommands of ``cmmsim``.

Heavy modules are imported inside functions, because ``--help`` must not wait for CasADi and OpenGL.
"""
