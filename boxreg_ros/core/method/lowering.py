"""How numba makes kernels into instructions for LLVM: with less of them than by itself."""

from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from numba.core import cgutils, ir, transforms, types
from numba.core.analysis import compute_cfg_from_blocks
from numba.core.codegen import CPUCodeLibrary
from numba.core.lowering import Lower
from numba.core.postproc import PostProcessor, VariableLifetime
from numba.np import arrayobj

llvm = vars(cgutils)['ir']  # of llvmlite
IRBuilder, InsertValue = llvm.IRBuilder, llvm.instructions.InsertValue
_StructProxy = cgutils._StructProxy
_extract, _process = IRBuilder.extract_value, PostProcessor.run
_make_array, _find_values = arrayobj.make_array, Lower._find_singly_assigned_variable


def _extract_known(self: Any, structure: Any, index: Any, name: str = '') -> Any:
    """Return a field of a structure: the value that was put there, where that is known."""
    index = list(index) if isinstance(index, list | tuple) else [index]
    inner = structure
    while isinstance(inner, InsertValue) and len(inner.indices) == len(index):
        if list(inner.indices) == index:
            return inner.value
        inner = inner.aggregate
    return _extract(self, inner, index, name)


class _ValueProxy:
    """
    Methods in place of those of numba's `ValueStructProxy`: fields are values.

    Numba puts an array into memory to read one of its fields. Here fields are values in the block
    of instructions that has made the structure; elsewhere, and from then on, it is in memory.

    """

    def __init__(
        self: Any, context: Any, builder: Any, value: Any = None, ref: Any = None
    ) -> None:
        self._known = None
        if ref is not None or type(self)._make_refs is not _StructProxy._make_refs:
            _StructProxy.__init__(self, context, builder, value, ref)
            return
        self._context, self._builder, self._block = context, builder, builder.block
        self._datamodel = context.data_model_manager[self._fe_type]
        self._be_type = self._get_be_type(self._datamodel)
        self._known = self._be_type(None) if value is None else value

    def __getattr__(self: Any, name: str) -> Any:
        if name not in ('_value', '_outer_ref'):
            return _StructProxy.__getattr__(self, name)
        builder, known, self._known = self._builder, self._known, None
        self._value = self._outer_ref = cgutils.alloca_once(builder, self._be_type)
        if builder.block is self._block:
            builder.store(known, self._value)
        else:
            with builder.goto_block(self._block):
                builder.store(known, self._value)
        return self._value

    def __getitem__(self: Any, index: int) -> Any:
        if _is_value(self):
            return self._builder.extract_value(self._known, index)
        return _StructProxy.__getitem__(self, index)

    def __setitem__(self: Any, index: int, value: Any) -> None:
        if _is_value(self) and value.type == self._be_type.elements[index]:
            self._known = self._builder.insert_value(self._known, value, index)
        else:
            _StructProxy.__setitem__(self, index, value)

    def _getvalue(self: Any) -> Any:
        return self._known if _is_value(self) else _StructProxy._getvalue(self)


def _is_value(proxy: Any) -> bool:
    """Return whether the fields of a structure are values here."""
    return proxy._known is not None and proxy._builder.block is proxy._block


def _make_plain_array(array_type: Any) -> Any:
    """Return the class for an array; that of numba keeps the shape in memory."""
    if type(array_type) is types.Array:
        return cgutils.create_struct_proxy(array_type)
    return _make_array(array_type)


def _index(context: Any, builder: Any, kind: Any, index: Any, size: Any) -> Any:
    """
    Return an index as it is, where numba would add the size to a negative one.

    That takes instructions at each place, and keeps many loops from vector instructions.

    """
    return context.cast(builder, index, kind, types.intp)


def _find_more_values(self: Any) -> None:
    """
    Find the variables that are values: assigned once, before each use.

    Numba takes those that one block uses. Here these are all whose assignment dominates the uses;
    where references are counted, arrays of several blocks stay in memory.

    """
    blocks = self.func_ir.blocks
    if self.func_ir.func_id.is_generator:
        _find_values(self)
        return
    assigned: dict[str, list[int]] = defaultdict(list)
    used: dict[str, set[int]] = defaultdict(set)
    early = set()
    for label, block in sorted(blocks.items()):
        for statement in block.body:
            names = _names_used(statement)
            early |= names - assigned.keys()
            for name in names:
                used[name].add(label)
            if isinstance(statement, ir.Assign):
                assigned[statement.target.name].append(label)
    dominators = compute_cfg_from_blocks(blocks).dominators()
    models = self.context.data_model_manager
    self._blk_local_varmap = {}
    self._singly_assigned_vars = {
        name
        for name, labels in assigned.items()
        if len(labels) == 1 and name not in early
        and all(labels[0] in dominators[label] for label in used[name])
        and (
            used[name] <= {labels[0]} or not self.context.enable_nrt
            or not models[self.typeof(name)].contains_nrt_meminfo()
        )
    }  # fmt: skip


def _names_used(statement: Any) -> set[str]:
    """Return the names of the variables that a statement reads or deletes."""
    if isinstance(statement, ir.Del):
        return {statement.value}
    inner = statement.value if isinstance(statement, ir.Assign) else statement
    if isinstance(inner, ir.Inst):
        return {variable.name for variable in inner.list_vars()}
    return {inner.name} if isinstance(inner, ir.Var) else set()


def _process_shortly(self: Any, emit_dels: bool = False, extend_lifetimes: bool = False) -> None:
    """Do what is done after a pass; what is alive where is found out at the end alone."""
    if emit_dels or self.func_ir.is_generator:
        _process(self, emit_dels, extend_lifetimes)
        return
    self.func_ir.blocks = transforms.canonicalize_cfg(self.func_ir.blocks)
    self.func_ir.variable_lifetime = VariableLifetime(self.func_ir.blocks)
    self.func_ir.generator_info = None


def _optimize_definitions(self: Any, module: Any) -> None:
    """Optimise the functions of a module; numba sets up the same for those that it calls."""
    module.data_layout = self._codegen._data_layout
    for function in module.functions:
        if not function.is_declaration:
            passes, builder = self._codegen._function_pass_manager()
            passes.run(function, builder)


SHORTER = (
    (IRBuilder, 'extract_value', _extract_known),
    *(
        (cgutils.ValueStructProxy, name, method)
        for name, method in vars(_ValueProxy).items()
        if callable(method)
    ),
    (arrayobj, 'make_array', _make_plain_array),
    (arrayobj, 'fix_integer_index', _index),
    (Lower, '_find_singly_assigned_variable', _find_more_values),
    (PostProcessor, 'run', _process_shortly),
    (CPUCodeLibrary, '_optimize_functions', _optimize_definitions),
)
"""Of numba and LLVM's builder: class or module, name, and what replaces it."""


@contextmanager
def replaced(*replacements: tuple[Any, str, Any]) -> Iterator[None]:
    """Replace attributes of objects in the block: object, name, and value of each."""
    before = [(owner, name, vars(owner).get(name)) for owner, name, _ in replacements]
    for owner, name, value in replacements:
        setattr(owner, name, value)
    try:
        yield
    finally:
        for owner, name, value in before:
            if value is None:
                delattr(owner, name)
            else:
                setattr(owner, name, value)
