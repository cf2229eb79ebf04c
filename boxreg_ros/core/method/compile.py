"""How kernels are compiled: by numba, once, kept on disk."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, partial
import gc
from hashlib import sha256
from math import prod
from pathlib import Path
import re
from typing import Any
from warnings import warn

import numba
from numba.core import cgutils, event, types
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler, Flags
from numba.core.runtime.nrt import rtsys
from numba.extending import intrinsic

REORDER = {'contract', 'reassoc'}
"""Sums may be reordered for vector instructions; NaN and infinity are handled as usual."""

OLDEST_NUMBA = (0, 61)
"""Measured: of 0.59.1, 0.60.0, 0.61.2 and 0.68.1 the first two, whose LLVM is 14, make NaN of
sums that may be reordered."""

IMPORTED = re.compile(r'^from [\w.]*?(\w+) import', re.MULTILINE)
"""The last name of a module that a source imports from."""

DIGEST_LENGTH = 12
"""Letters of the digest of the sources. Chosen: 48 bits."""

UNUSED_PASSES = {
    'WithLifting', 'InlineClosureLikes', 'RewriteSemanticConstants', 'RewriteDynamicRaises',
    'MakeFunctionToJitFunction', 'InlineInlinables', 'FindLiterallyCalls', 'InlineOverloads',
    'NopythonRewrites',
}  # fmt: skip
"""
Passes of numba that are left out.

They are for what no kernel has: `with`, inner functions and generators, errors with arguments,
arguments that have to be literal, functions to be inlined by numba, and sums of whole arrays.
"""


def refuse_old(version: str) -> None:
    """Raise ImportError for a `version` of numba before `OLDEST_NUMBA`."""
    if tuple(map(int, version.split('.')[:2])) < OLDEST_NUMBA:
        oldest = '.'.join(map(str, OLDEST_NUMBA))
        raise ImportError(
            f'numba: expected {oldest} or newer, got {version}, which makes NaN of sums: '
            f"pip install 'numba>={oldest}'"
        )


refuse_old(numba.__version__)


class _CollectionsAfterwards(event.Listener):
    """Stops the garbage collector while a kernel is compiled: a tenth of the time."""

    _depth = 0
    _was_enabled = False

    def on_start(self, event: object) -> None:
        if not self._depth:
            self._was_enabled = gc.isenabled()
            gc.disable()
        self._depth += 1

    def on_end(self, event: object) -> None:
        self._depth -= 1
        if not self._depth and self._was_enabled:
            gc.enable()


event.register('numba:compile', _CollectionsAfterwards())


def loop(function: Callable[..., Any]) -> Any:
    """
    Compile a kernel that makes no array: views then count no references.

    That takes a tenth less time, and a tenth less to compile: where a kernel has to make arrays,
    it hands them to one that does the work.

    """
    return kernel(function, _nrt=False)


def kernel(function: Callable[..., Any], **options: Any) -> Any:
    """
    Compile a function of numbers and arrays at its first call.

    It runs without the interpreter's lock, so that threads can share the windows of a batch. As
    no window depends on another, the results do not depend on the number of threads. Numba's own
    threads are not used: they do not survive a fork, and workers of `boxreg relabel` are forked.
    No index may be negative: none is counted from the end of an array.

    Notes
    -----
    Numba compiles the kernels that a kernel calls into its cache file, but compares the file with
    the source of the caller only. The qualified name, which numba puts into the name of the cache
    file, therefore gets a digest of all sources that the caller imports. Modules of kernels import
    functions and constants from their own folder only.
    Loops with constant bounds are written out, with all that they call: those whose bounds are
    lengths of arrays take a fraction of that to compile, and where they run once a window no
    longer to run.

    """
    source = Path(function.__code__.co_filename)
    function.__qualname__ += f'_{sources_digest(source)}'
    options = {'_nrt': True} | options  # unset, it is that of the kernel that calls this one
    options |= {'nogil': True, 'error_model': 'numpy', 'fastmath': REORDER}
    options['pipeline_class'] = _KernelCompiler
    options['no_cfunc_wrapper'] = True  # for calls from C: a fifteenth of the time to compile
    options['forceinline'] = False  # left unset, numba compiles functions of its own twice
    try:
        dispatcher = _with_linked_form(numba.njit(function, cache=True, **options), options)
    except RuntimeError as error:  # no folder for the cache can be written
        if function.__name__ == FIRST_KERNEL:
            warn(
                f'numba cache: expected a folder that can be written, got {error}; every process '
                f'compiles the solver again, for about a minute: set NUMBA_CACHE_DIR',
                RuntimeWarning,
                stacklevel=2,
            )
        return _with_linked_form(numba.njit(function, **options), options)
    _recover_from_damage(dispatcher._cache)
    _go_on_without_room(dispatcher._cache)
    return dispatcher


@intrinsic(prefer_literal=True)
def small_array(typing: Any, rows: Any, columns: Any = None) -> Any:
    """
    Return an array of constant shape on the stack, for a `loop`; it must not be returned.

    It counts no references and is compiled in a third of the time of a numpy array.

    """
    from numba.np import arrayobj  # slow, and no kernel that is loaded needs it

    sizes = [rows] if columns is None else [rows, columns]
    shape = [size.literal_value for size in sizes]
    array = types.Array(types.float64, len(shape), 'C')

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        made = arrayobj.make_array(array)(context, builder)
        data = cgutils.alloca_once(builder, context.get_value_type(types.float64), prod(shape))
        data.align = 64  # of vectors, and lines of the cache
        number = partial(context.get_constant, types.intp)
        strides = [number(8 * prod(shape[k + 1 :])) for k in range(len(shape))]
        arrayobj.populate_array(made, data, list(map(number, shape)), strides, number(8), None)
        return made._getvalue()

    return array(rows, types.Omitted(None) if columns is None else columns), generate


class _CalledLibrary(JITCodeLibrary):
    """
    Code that Python calls, kept on disk as machine code and the names that it defines.

    Numba would keep its intermediate code, too, for callers, which here link another form. To read
    that is half of the time to load a kernel, and five times its memory.

    """

    def serialize_using_object_code(self) -> tuple[str, str, tuple[bytes, bytes]]:
        """Return what is kept on disk."""
        names = self._codegen.create_library(self.name)
        module = names.create_ir_module(self.name)
        for symbol in (*self._final_module.functions, *self._final_module.global_variables):
            if not symbol.is_declaration:
                variable = cgutils.add_global_variable(module, cgutils.bool_t, symbol.name)
                variable.initializer = cgutils.false_bit
        names.add_ir_module(module)
        return self.name, 'object', (self._get_compiled_object(), names._final_module.as_bitcode())


class _LinkedLibrary(JITCodeLibrary):
    """
    Code that is linked into that of its callers, and only there optimised and made machine code.

    Notes
    -----
    The methods replace some of numba's own: if it renames these, kernels take longer to compile.

    """

    def _optimize_final_module(self) -> None:
        """Leave that to the callers."""

    def _finalize_final_module(self) -> None:
        """Make no machine code."""
        self._finalized = True


class _QuickFlags(Flags):
    """
    Flags that are compared by the values that are set.

    Numba looks up its own functions by types and flags. To compare all values, of properties, is a
    tenth of its time to compile.

    """

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Flags) and self._values == other._values

    def __hash__(self) -> int:
        return hash(frozenset(self._values))

    def values(self) -> dict[str, Any]:
        """Return the values that are set; numba asks for them before each pass."""
        return self._values


_RESULTS: dict[Any, Any] = {}
"""What operators give, by operator and types of operands."""


def _kept_or_resolved(resolve: Callable[..., Any], func: Any, args: Any, kws: Any) -> Any:
    """Return the signature of a call; that of an operator from `_RESULTS` once it is known."""
    operation = getattr(func, 'typing_key', func)
    is_operator = getattr(operation, '__module__', None) == '_operator'
    if not is_operator or not all(isinstance(t, types.Number | types.Array) for t in args):
        return resolve(func, args, kws)
    if (operation, args) not in _RESULTS:
        _RESULTS[operation, args] = resolve(func, args, kws)
    return _RESULTS[operation, args]


@contextmanager
def _looked_up_once(state: Any) -> Iterator[None]:
    """
    Let numba look up operators once for each types of operands, and for no new functions.

    It tries all forms of an operator, a dozen, at each place of a kernel that has one, and looks
    for functions that were defined meanwhile wherever an array is used. Indices are used as they
    are. Its contexts are those of all libraries of a process, and as before after the block.

    """
    from numba.np import arrayobj  # slow, and no kernel that is loaded needs it

    typing, target = state.typingctx, state.targetctx
    kept = partial(_kept_or_resolved, typing.resolve_function_type)
    methods = (typing, 'resolve_function_type', kept), (target, 'refresh', lambda: None)
    # In the block of a kernel that calls this one they are replaced already.
    replaced = [method for method in methods if method[1] not in vars(method[0])]
    for context, name, method in replaced:
        setattr(context, name, method)
    fix_index, arrayobj.fix_integer_index = arrayobj.fix_integer_index, _index
    try:
        yield
    finally:
        arrayobj.fix_integer_index = fix_index
        for context, name, _ in replaced:
            delattr(context, name)


def _index(context: Any, builder: Any, kind: Any, index: Any, size: Any) -> Any:
    """
    Return an index as it is, where numba would add the size to a negative one.

    That takes instructions at each place, and keeps many loops from vector instructions.

    """
    return context.cast(builder, index, kind, types.intp)


class _KernelCompiler(Compiler):
    """Compiles kernels, without what takes numba long and changes none of them."""

    def define_pipelines(self) -> Any:
        """Return the usual passes but `UNUSED_PASSES`."""
        (pipeline,) = super().define_pipelines()
        pipeline.passes = [
            step for step in pipeline.passes if step[0].__name__ not in UNUSED_PASSES
        ]
        return [pipeline]

    def compile_extra(self, function: Callable[..., Any]) -> Any:
        """Return the compiled kernel."""
        state = self.state
        state.flags = _QuickFlags(state.flags)
        if state.library is None:
            state.library = _CalledLibrary(state.targetctx.codegen(), function.__qualname__)
            state.library.enable_object_caching()
        with _looked_up_once(state):
            return super().compile_extra(function)


class _LinkedCompiler(_KernelCompiler):
    """Compiles a kernel for the kernels that call it."""

    def define_pipelines(self) -> Any:
        """Return the usual passes; they end before there is machine code."""
        # Numba's own functions are compiled for a copy of the flags: once for both forms of ours.
        self.state.flags.no_compile = True
        self.state.flags.no_cpython_wrapper = True
        return super().define_pipelines()

    def compile_extra(self, function: Callable[..., Any]) -> Any:
        """Return what is linked, registered under a key of its own."""
        state = self.state
        state.library = _LinkedLibrary(state.targetctx.codegen(), function.__qualname__)
        result = super().compile_extra(function)._replace(entry_point=object())
        state.targetctx.insert_user_function(result.entry_point, result.fndesc, [result.library])
        return result


def _with_linked_form(dispatcher: Any, options: dict[str, Any]) -> Any:
    """
    Return a kernel of which other kernels link a second form, without machine code of its own.

    Numba optimises each kernel, makes machine code of it and keeps it on disk, and then does so
    again for each kernel that calls it: a third of the time to compile. Here that is done for the
    kernels that Python calls. Kernels raise no errors: numba gives linked ones no environment for
    that.

    """
    linked = numba.njit(dispatcher.py_func, **options | {'pipeline_class': _LinkedCompiler})

    def add_overload(result: Any) -> None:
        linked.overloads[tuple(result.signature.args)] = result  # Python does not call it

    linked.add_overload = add_overload
    dispatcher.get_call_template = linked.get_call_template
    dispatcher.get_overload = linked.get_overload
    return dispatcher


def _recover_from_damage(cache: Any) -> None:
    """
    Let a damaged cache file be written again, with a warning; numba itself would raise.

    A kernel is loaded without what numba sets up to compile one: 0.25 s of imports, and 35 MB.

    """

    def load_or_compile(signature: Any, target: Any) -> Any:
        rtsys.initialize(target)  # the memory of arrays
        try:
            return cache._load_overload(signature, target)
        except Exception as error:  # whatever pickle raises for other bytes
            warn(
                f'numba cache: expected compiled kernels in {cache.cache_path}, got a damaged '
                f'file ({type(error).__name__}); it is written again: if that comes back, delete '
                f'the folder',
                RuntimeWarning,
                stacklevel=2,
            )
            cache.flush()
            return None

    cache.load_overload = load_or_compile


def _go_on_without_room(cache: Any) -> None:
    """Let a kernel that cannot be written to disk be used, with a warning; numba would raise."""
    save = cache.save_overload

    def save_or_warn(*arguments: Any) -> None:
        try:
            save(*arguments)
        except OSError as error:
            _warn_once(
                f'numba cache: expected room for compiled kernels in {cache.cache_path}, got '
                f'"{error.strerror}"; every process compiles the solver again: make room, or set '
                f'NUMBA_CACHE_DIR to another folder'
            )

    cache.save_overload = save_or_warn


@cache
def _warn_once(text: str) -> None:
    """Warn unless the same text has been given for another kernel."""
    warn(text, RuntimeWarning, stacklevel=2)


FIRST_KERNEL = 'fill_rotation'
"""The kernel that is compiled first: one warning is enough."""


@cache
def sources_digest(source: Path) -> str:
    """Return a digest of a source and of all that it imports from its folder, one by another."""
    sources = [source]
    for path in sources:  # which grows
        modules = IMPORTED.findall(path.read_text(encoding='utf-8'))
        known = (source.with_name(f'{module}.py') for module in modules)
        sources += {path for path in known if path.is_file() and path not in sources}
    digest = sha256()
    for path in sorted(sources):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:DIGEST_LENGTH]
