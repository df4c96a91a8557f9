# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Leaves out what Numba does for functions that are never called from Python, only linked.

Numba compiles each function that a kernel calls as if it were to run by itself: it optimises it,
makes machine code of it and entries for callers from C. Of all that a library needs the unoptimised
code only, which is linked to the kernels that call it and optimised with them. Numba also compiles
a kernel once more to export it. Without all that, libraries are made in two thirds of the time.

This rests on what Numba 0.68 keeps to itself. Where a name is missing, making libraries fails, and
Numba compiles the kernels in the process.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any

__all__ = ["shorten_compilation"]


def shorten_compilation(processor: str) -> dict[Callable[..., object], Any]:
    """Change Numba in this process, which does nothing but make a library.

    Args:
        processor: LLVM's name of the processor that the library is for.

    Returns:
        Where compiled kernels must be entered by their functions before they are exported.
    """
    context: Any = import_module("numba.core.registry").cpu_target.target_context
    _replace(context, "_internal_codegen", _codegen("callees", processor))
    lowering: Any = import_module("numba.core.lowering")
    _replace(lowering.BaseLower, "create_cfunc_wrapper", lambda lower: None)
    _keep_types_of_calls(import_module("numba.core.types.functions").BaseFunction)
    _find_variables_faster(import_module("numba.core.ir"))
    kernels: dict[Callable[..., object], Any] = {}
    exporter: Any = import_module("numba.pycc").compiler
    _replace(exporter, "compile_extra", _exporting(kernels))
    return kernels


def _replace(owner: Any, name: str, value: object) -> None:
    """Replace an attribute that must be there: a new one would have no effect."""
    getattr(owner, name)
    setattr(owner, name, value)


def _codegen(name: str, processor: str) -> Any:
    """Where functions go that kernels call: to libraries that are linked, and never run."""
    codegen: Any = import_module("numba.core.codegen")

    class Library(codegen.AOTCodeLibrary):  # type: ignore[misc]  # Numba has no types
        def _optimize_final_module(self) -> None:
            """Leave it to the library of kernels that it becomes a part of."""

        def get_pointer_to_function(self, name: str) -> int:
            return 0  # no machine code

    class Codegen(codegen.AOTCPUCodegen):  # type: ignore[misc]
        _library_class = Library

        def set_env(self, name: str, environment: object) -> None:
            """Nothing that runs has an environment."""

    return Codegen(name, processor)


def _keep_types_of_calls(function: Any) -> None:
    """Find the types of a call once for all calls of a function with the same types.

    An operator tries dozens of declarations until one of them fits. Types of functions are kept
    alive, too: Numba forgets those that it does not need for a while, and compiles them again.
    """
    find = function.get_call_type
    found: dict[Any, Any] = {}

    def get_call_type(self: Any, context: Any, args: Any, kws: Any) -> Any:
        key = self, context, tuple(args), tuple(kws.items())
        if key not in found:
            found[key] = find(self, context, args, kws)
        return found[key]

    function.get_call_type = get_call_type


def _find_variables_faster(representation: Any) -> None:
    """Look at the type of what cannot hold variables first, which is most of an instruction.

    Numba lists the variables of all instructions some ten times for each function.
    """
    python, variable = representation.Inst._rec_list_vars, representation.Var
    without = {str, int, float, bool, type(None), representation.Loc}

    def listed(self: Any, value: Any) -> list[Any]:
        kind = type(value)
        if kind in without:
            return []
        return [value] if kind is variable else python(self, value)

    representation.Inst._rec_list_vars = listed


def _exporting(kernels: dict[Callable[..., object], Any]) -> Callable[..., Any]:
    """Replaces `compile_extra` of the exporter: exports kernels that have been compiled.

    That is also under their own model of errors, for which the exporter has no option. Functions
    that kernels call have no environment: they do not handle objects of Python.
    """

    def compile_extra(
        _: object, context: Any, function: Any, args: Any, *__: object, library: Any, **___: object
    ) -> Any:
        compiled = kernels[function].overloads[tuple(args)]
        parts = compiled.fndesc, compiled.environment, compiled.call_helper
        # of a context that counts references to arrays
        context.subtarget(enable_nrt=True).create_cpython_wrapper(library, *parts)
        # only what something refers to is linked: the wrapper must be there before
        library._final_module.link_in(compiled.library._get_module_for_linking(), preserve=True)
        return compiled._replace(library=library, target_context=context)

    return compile_extra
