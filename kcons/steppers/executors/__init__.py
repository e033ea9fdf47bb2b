"""Who makes the operations of a step on arrays.

- `frame`: what a step counts from, and the state that it ends in
- `piecewise`: one operation after another
- `fused`: kicks and drifts in few compiled calls
"""
