"""The public names of a package, each with its docstring, in the groups that the package's own
docstring makes.
"""

import importlib
import inspect


def overview(name: str) -> str:
    """The docstring of a package, which lists its public names."""
    return f"```text\n{inspect.getdoc(importlib.import_module(name))}\n```"


def package(name: str) -> str:
    """Directives for all of a package's public names, in its order."""
    module = importlib.import_module(name)
    parts = [f"```{{py:module}} {name}\n```"]
    for public in module.__all__:
        found = getattr(module, public)
        if inspect.ismodule(found):
            parts += [f"## {name}.{public}", f"```text\n{inspect.getdoc(found)}\n```"]
            parts += [
                _directive(f"{name}.{public}", inner, getattr(found, inner))
                for inner in found.__all__
            ]
        else:
            parts.append(_directive(name, public, found))
    return "\n\n".join(parts) + "\n"


def _directive(module: str, name: str, found: object) -> str:
    kind = "class" if inspect.isclass(found) else "function" if inspect.isroutine(found) else "data"
    if inspect.isclass(found) and issubclass(found, BaseException):
        kind = "exception"
    options = "   :members:\n   :exclude-members: model_config\n" if kind == "class" else ""
    return f"```{{eval-rst}}\n.. auto{kind}:: {module}.{name}\n{options}```"
