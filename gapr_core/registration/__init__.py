"""Partial-to-full registration: prepare, propose, verify, refine, assess, conclude.

| package | holds |
|---|---|
| `registrar` | the algorithm, top to bottom |
| `problem` | source, target, sensor, crop |
| `proposals` | hypotheses: the network, the exhaustive search, regions of a scene |
| `fit` | verification and refinement of poses, and the same for changed sources |
| `uncertainty` | covariance, correction of a smooth bias, errors at targets |
| `confidence` | features and the classifier |
| `checks` | checks of a pose, and the answer that follows |
| `scenes` | a camera's cloud, most of which may not be bone |
| `streams` | `Tracker`, `Accumulator`, `LookAccumulator` |

`guidance` ranks where to measure next; `check_points` tests a pose with points outside the source; `caveats` adds
warnings to a result.
"""
