"""The algorithm: prepare, propose, verify, refine, assess.

Where to read on, in the order in which a source passes:

- `registrar` has the five steps on one screen, and asks one proposer after the other.
- `target`, `source`: what is known of both before the first pose. `sensor`: what is known of its errors.
- `proposals.search` and `proposals.network` propose poses, `proposals.consensus` makes them of correspondences.
- `verification` keeps a few distinct poses, `refinement` makes the best one exact. `surface_kernels` has the residual
  of one point, `block_kernels` the normal equations of many, `kernels` a Gauss-Newton step, `fit_kernels` the weights.
- `assessment` puts the answer together, of: `covariance` (with `bias_field`), `features` (with `mirror`, `other_size`,
  `roughness`), `confidence` (an `additive` model of the features), `rules` (what refuses a pose, however probable;
  `checks` asks the costly ones), `limits` (what keeps it from being sure), `words` for all of these; `standoff` asks
  a refused source for the radius of a tip.
- `smooth_bias`, `precision` and `precision_model` correct what is accepted: its pose, and the error that is expected.
- `guidance`: where to look next. `check_points`: does the pose hold where the source was not? `cortices`: bones whose
  model has an inner surface.

A camera's cloud goes another way: `scene` holds what it saw from one place or several, `scene_rounds` registers it with
`clutter` (with `proposals.regions`, `free_space`, `clutter_kernels`) and `explained`; `look_agreement`: do the looks
show the bone in one place? Streams: `tracking` (with `memory`, `evidence`, `repeats`, `stream_misfit` of
`shared_misfit`), `following` between two of them, `accumulation`, for a camera `look_accumulation`, both with
`far_away`. `creep`: did the bone move while its sources were collected? `rigidity`: is a source strained or in two
pieces? Both ask `further_unknowns`. `separate_patches`: does one patch lie off the bone? `doubles`: is the bone in it
twice? `crop` cuts a cloud before, `inputs` takes poses and places.
"""
