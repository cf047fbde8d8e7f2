"""Mutation operators, and every mutant they make of a file.

cosmic-ray supplies the general operators. The operators here imitate faults that people make in geometric
code: the other view's camera, an inverted ratio, a missing transpose, a forgotten setting.
"""

import re
from collections.abc import Iterator
from functools import cache

import parso
from cosmic_ray.mutating import mutate_code
from cosmic_ray.operators import (
    binary_operator_replacement,
    boolean_replacer,
    break_continue,
    comparison_operator_replacement,
    exception_replacer,
    number_replacer,
    remove_decorator,
    unary_operator_replacement,
    zero_iteration_for_loop,
)
from cosmic_ray.operators.operator import Operator
from parso.tree import Leaf, NodeOrLeaf

#: One replacement per operator, so that an addition is not eleven times as likely to be drawn as a name.
BINARY = (
    "Add_Sub Sub_Add Mul_Div Div_Mul FloorDiv_Div Mod_Mul Pow_Mul BitAnd_BitOr BitOr_BitAnd BitXor_BitOr "
    "LShift_RShift RShift_LShift"
).split()
COMPARISON = (
    "Eq_NotEq NotEq_Eq Lt_LtE Lt_Gt LtE_Lt LtE_GtE Gt_GtE Gt_Lt GtE_Gt GtE_LtE Is_IsNot IsNot_Is"
).split()
UNARY = "Delete_USub Delete_Not Delete_Invert".split()

#: Names that a person confuses, as whole words of an identifier such as ``K_left`` or ``row``.
TWINS = """
    left right; width height; fx fy; cx cy; row column; rows columns; u v; x y; near far; first last;
    before after; scale shift; source target; start end; above below""".split(";")
#: These exist in a library, so that the other name need not occur in the same function.
LIBRARY_TWINS = """
    min max; minimum maximum; amin amax; argmin argmax; any all; floor ceil; sin cos; mean median; log exp;
    log2 exp2; degrees radians; zeros ones""".split(";")
TWIN = {
    name: other
    for pair in (*TWINS, *LIBRARY_TWINS)
    for one, two in [pair.split()]
    for name, other in ((one, two), (two, one))
}
LIBRARY_NAMES = {name for pair in LIBRARY_TWINS for name in pair.split()}


class ConfuseNames(Operator):
    """``K_left`` becomes ``K_right``, ``min`` becomes ``max``: the name that a person confuses with it."""

    def mutation_positions(self, node):
        if node.type == "name" and not _is_binding(node) and _twin(node):
            yield node.start_pos, node.end_pos

    def mutate(self, node, index):
        node.value = _twin(node)
        return node

    @classmethod
    def examples(cls):
        return ()


class InvertRatio(Operator):
    """``a / b`` becomes ``b / a``, and ``a @ b`` becomes ``b @ a``."""

    def mutation_positions(self, node):
        if node.type == "term" and len(node.children) == 3 and node.children[1].value in ("/", "@"):
            yield node.start_pos, node.end_pos

    def mutate(self, node, index):
        _exchange(node, 0, 2)
        return node

    @classmethod
    def examples(cls):
        return ()


#: Functions whose result does not depend on the order of their arguments.
SYMMETRIC = set(
    "minimum maximum min max hypot addcmul addcmul_ vecdot dot equal array_equal allclose isclose samefile "
    "logical_and logical_or union intersection".split()
)


class ExchangeArguments(Operator):
    """``f(a, b)`` becomes ``f(b, a)``, for neighbouring positional arguments."""

    def mutation_positions(self, node):
        for first, second in self._pairs(node):
            yield first.start_pos, second.end_pos

    def mutate(self, node, index):
        first, second = list(self._pairs(node))[index]
        _exchange(node, node.children.index(first), node.children.index(second))
        return node

    @staticmethod
    def _pairs(node):
        if node.type != "arglist" or node.parent.type not in ("trailer", "power", "atom_expr"):
            return
        function = node.parent.get_previous_sibling()
        if function is not None and function.get_last_leaf().value in SYMMETRIC:
            return
        arguments = [child for child in node.children if child.type != "operator"]
        for first, second in zip(arguments, arguments[1:], strict=False):
            plain = first.type != "argument" and second.type != "argument"
            if plain and first.get_code().strip() != second.get_code().strip():
                yield first, second

    @classmethod
    def examples(cls):
        return ()


class DropKeyword(Operator):
    """``f(a, b=c)`` becomes ``f(a)``: a forgotten setting."""

    def mutation_positions(self, node):
        for argument in self._keywords(node):
            yield argument.start_pos, argument.end_pos

    def mutate(self, node, index):
        at = node.children.index(list(self._keywords(node))[index])
        # The comma before it goes too, or the one after it if it is the first.
        del node.children[max(at - 1, 0) : max(at - 1, 0) + 2]
        return node

    @staticmethod
    def _keywords(node):
        if node.type == "arglist":
            for child in node.children:
                if child.type == "argument" and child.children[1] == "=":
                    yield child

    @classmethod
    def examples(cls):
        return ()


class DropTranspose(Operator):
    """``R.T`` becomes ``R``; ``-1, -2`` in a call of ``transpose`` is left to the other operators."""

    def mutation_positions(self, node):
        if node.type == "trailer" and node.get_code() in (".T", ".mT"):
            yield node.start_pos, node.end_pos

    def mutate(self, node, index):
        return None

    @classmethod
    def examples(cls):
        return ()


def _exchange(node: NodeOrLeaf, first: int, second: int) -> None:
    """Exchange two children, each keeping the white space in front of its place."""
    a, b = node.children[first], node.children[second]
    before_a, before_b = a.get_first_leaf().prefix, b.get_first_leaf().prefix
    a.get_first_leaf().prefix, b.get_first_leaf().prefix = before_b, before_a
    node.children[first], node.children[second] = b, a


def _twin(leaf: Leaf) -> str | None:
    """The name that a person confuses with this one, if it is defined here."""
    words = leaf.value.split("_")
    for at, word in enumerate(words):
        if word in TWIN:
            other = "_".join([*words[:at], TWIN[word], *words[at + 1 :]])
            library = len(words) == 1 and word in LIBRARY_NAMES
            return other if library or other in _names_near(leaf) else None
    return None


def _names_near(leaf: Leaf) -> frozenset[str]:
    scope = parso.python.tree.search_ancestor(leaf, "funcdef", "classdef", "file_input")
    return _words(scope.get_code())


@cache
def _words(code: str) -> frozenset[str]:
    return frozenset(re.findall(r"\w+", code))


def _is_binding(leaf: Leaf) -> bool:
    """Whether a name is defined here (a parameter, a target, a keyword, an import), not used."""
    parent = leaf.parent
    if parent.type in (
        "param",
        "funcdef",
        "classdef",
        "import_name",
        "import_from",
        "import_as_name",
        "import_as_names",
    ):
        return True
    if parent.type == "argument":
        return parent.children[0] is leaf and parent.children[1] == "="
    return leaf.is_definition() if hasattr(leaf, "is_definition") else False


def _operators() -> dict[str, Operator]:
    classes = [getattr(binary_operator_replacement, f"ReplaceBinaryOperator_{name}") for name in BINARY]
    classes += [
        getattr(comparison_operator_replacement, f"ReplaceComparisonOperator_{name}") for name in COMPARISON
    ]
    classes += [getattr(unary_operator_replacement, f"ReplaceUnaryOperator_{name}") for name in UNARY]
    classes += [
        boolean_replacer.AddNot,
        boolean_replacer.ReplaceTrueWithFalse,
        boolean_replacer.ReplaceFalseWithTrue,
        boolean_replacer.ReplaceAndWithOr,
        boolean_replacer.ReplaceOrWithAnd,
        break_continue.ReplaceBreakWithContinue,
        break_continue.ReplaceContinueWithBreak,
        exception_replacer.ExceptionReplacer,
        number_replacer.NumberReplacer,
        remove_decorator.RemoveDecorator,
        zero_iteration_for_loop.ZeroIterationForLoop,
        ConfuseNames,
        InvertRatio,
        ExchangeArguments,
        DropKeyword,
        DropTranspose,
    ]
    return {cls.__name__: cls() for cls in classes}


OPERATORS = _operators()
_OF_LEAVES = {
    "name": ["ConfuseNames"],
    "number": ["NumberReplacer"],
    "operator": [name for name in OPERATORS if name.startswith("ReplaceBinaryOperator")],
    "keyword": [name for name in OPERATORS if re.match("Replace(True|False|And|Or|Break|Continue)", name)],
}
_OF_NODES = [name for name in OPERATORS if not any(name in names for names in _OF_LEAVES.values())]
#: The operators that may fit a node, by its type; asking each operator for each leaf takes ten times as long.
_FITTING = _OF_LEAVES | dict.fromkeys(["string", "newline", "endmarker", "fstring_start", "fstring_end"], [])


def positions(source: str) -> Iterator[tuple[str, int, int]]:
    """Operator, occurrence and line of every mutant of a file that is worth a run."""
    tree = parso.parse(source)
    skipped = _ignored_spans(tree)
    counts = dict.fromkeys(OPERATORS, 0)
    for node in _nodes(tree):
        for name in _FITTING.get(node.type, _OF_NODES):
            for start, end in OPERATORS[name].mutation_positions(node):
                occurrence, counts[name] = counts[name], counts[name] + 1
                if not any(first <= start and end <= last for first, last in skipped):
                    yield name, occurrence, start[0]


def mutated(source: str, operator: str, occurrence: int) -> str:
    """The file with one mutation."""
    code = mutate_code(source, OPERATORS[operator], occurrence)
    if code is None:
        raise ValueError(f"{operator} has no occurrence {occurrence} here")
    return code


def _nodes(node: NodeOrLeaf) -> Iterator[NodeOrLeaf]:
    yield node
    for child in getattr(node, "children", ()):
        yield from _nodes(child)


def _ignored_spans(tree: NodeOrLeaf) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Code that no test should notice: annotations, imports for type checkers, logging and the like."""
    spans = []
    for node in _nodes(tree):
        first, last = _ignored_part(node) or (None, None)
        if first is not None:
            spans.append((first.start_pos, last.end_pos))
    return spans


def _ignored_part(node: NodeOrLeaf) -> tuple[NodeOrLeaf, NodeOrLeaf] | None:
    """First and last node of what is ignored of a node."""
    if node.type == "annassign":
        return node.children[0], node.children[1]
    if node.type in ("param", "funcdef") and node.annotation is not None:
        return node.annotation, node.annotation
    if node.type == "operator" and node.parent.type in ("parameters", "lambdef"):
        return node, node  # the star in front of keyword-only parameters is no product
    if node.type == "argument" and node.get_code().strip() == "strict=True":
        return node, node  # of zip: states that lengths are equal, which they are by construction
    pattern = {
        "if_stmt": r"if TYPE_CHECKING",
        "expr_stmt": r"__all__\b|\w+: TypeAlias",
        "atom_expr": r"_?log(ger)?\.|logging\.|warnings\.warn\(",
        "decorator": r"@(overload|override|wraps|typing)",
    }.get(node.type)
    ignored = pattern is not None and re.match(pattern, node.get_code().strip())
    return (node, node) if ignored else None
