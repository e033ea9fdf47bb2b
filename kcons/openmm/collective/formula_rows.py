"""Formulas of kcons as Forces of OpenMM: the same text, one CustomCompoundBondForce a row."""

from __future__ import annotations

import ast
from collections.abc import Mapping, Sequence

import openmm

from kcons.constraints import Formula
from kcons.constraints.target import MovingTarget
from kcons.errors import UnsupportedError
from kcons.openmm.collective.row_forces import Row

_POWERS = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.Pow: "^"}


def as_rows(given: Row | openmm.Force | int | Formula | Sequence[Row | openmm.Force | int | Formula]) -> list[Row]:
    """Whatever stands for rows, or for one, as rows; a formula is one for each of its rows.

    Raises
    ------
    UnsupportedError
        A formula, or its target, that moves with the time; one of velocities.
    """
    rows: list[Row] = []
    for each in [given] if isinstance(given, Row | openmm.Force | int | Formula) else given:
        if isinstance(each, Formula):
            rows += formula_rows(each)
        else:
            rows.append(each if isinstance(each, Row) else Row(each))
    return rows


def formula_rows(item: Formula) -> list[Row]:
    """A `Row` for each row of a formula; positions are taken as OpenMM has them, no images are looked for."""
    if not item.holonomic:
        raise UnsupportedError(f"{item!r} holds velocities, not positions; hold it by kcons.openmm.hold")
    if item.moving or isinstance(item.target, MovingTarget):
        raise UnsupportedError(
            f"{item!r} moves with the time, which OpenMM's expressions do not know; hold it by kcons.openmm.hold"
        )
    rows = []
    for k in range(item.n_rows):
        numbers = dict(zip(item.names, item.values[k].tolist(), strict=True))
        force = openmm.CustomCompoundBondForce(item.width, expression(item.code().tree, numbers))
        force.addBond(item.atoms[k].tolist(), [])
        target = None if item.target is None else float(item.target[k])
        rows.append(Row(force, target, period=item.period, name=item.row_name(k)))
    return rows


def expression(tree: ast.expr, numbers: Mapping[str, float]) -> str:
    """A tree as OpenMM reads it, with every operation in brackets and numbers for parameters."""
    match tree:
        case ast.Constant(value=value):
            return repr(float(value))  # type: ignore[arg-type]
        case ast.Name(id="pi"):
            return "3.141592653589793"
        case ast.Name(id=name):
            return f"({numbers[name]!r})" if name in numbers else name
        case ast.UnaryOp(op=operation, operand=operand):
            inner = expression(operand, numbers)
            return f"(-{inner})" if isinstance(operation, ast.USub) else inner
        case ast.Call(func=ast.Name(id=name), args=args):
            return f"{name}({', '.join(expression(each, numbers) for each in args)})"
        case ast.BinOp(left=left, op=operation, right=right):
            return f"({expression(left, numbers)}{_POWERS[type(operation)]}{expression(right, numbers)})"
    raise AssertionError(ast.dump(tree))
