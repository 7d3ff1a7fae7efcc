# The tables that docs/results quotes, of the shipped models, each by its own command:
#
#   make -f benchmarks/tables.mk -j 2                    # hours; a stopped run goes on where it was
#   make -f benchmarks/tables.mk scenes mix              # these; `list` names all
#   make -f benchmarks/tables.mk real REAL=DIR           # as benchmarks/real.py
#   make -f benchmarks/tables.mk publish                 # the figures that are there go into docs
#
# Everything is left in $(OUT): tables, figures, records, pairs with their hash. Another commit needs another OUT.
SHELL   := bash -o pipefail
ANATOMY ?= ../shared/anatomy
OUT     ?= runs/tables
REAL    ?=
GAPR    := python -m gapr_core.cli
PUBLISH := python scripts/publish_table.py --folder $(OUT)/tables
FOUR    := --bones femur,tibia,pelvis,thoracic --split test
THREE   := --bones femur,tibia,pelvis --split test
TWO     := --bones femur,tibia --split test
export OMP_NUM_THREADS := 1
export OPENBLAS_NUM_THREADS := 1
export NUMBA_NUM_THREADS := 1

# How pairs are made: list = options of `gapr make-pairs`
comma := ,
looks = $(subst $(eval) ,$(comma),$(foreach kind,$(1),scene-$(kind)-look scene-$(kind)-looks))
of_one_sided      = --protocol L2,L3,wrong --count 40 --seed 0 $(FOUR)
of_clean          = --protocol paper,incomplete,L1,sweep --count 20 --seed 0 $(FOUR)
of_scenes         = --protocol scene-C1,scene-C2,scene-C3 --count 19 --seed 0 $(THREE)
of_scene_stereo   = --protocol scene-stereo,scene-layers --count 19 --seed 0 $(THREE)
of_scene_noisy    = --protocol scene-noisy --count 19 --seed 0 $(THREE)
of_scene_joint    = --protocol scene-joint,scene-theatre --count 28 --seed 0 $(TWO)
of_looks          = --protocol $(call looks,C3 stereo noisy layers) --count 13 --seed 0 $(THREE)
of_looks_joint    = --protocol $(call looks,joint theatre) --count 20 --seed 0 $(TWO)
of_looks_wrong    = --protocol scene-wrong-looks --count 20 --seed 0 $(THREE)
of_scene_table    = --protocol scene-table --count 14 --seed 0 $(FOUR)
of_scene_variants = --protocol scene-slit,scene-windows,scene-packed,scene-hand,scene-drape --count 6 --seed 0 $(THREE)
of_scene_wrong        = --protocol scene-wrong --count 19 --seed 0 $(THREE)
of_scene_wrong_stereo = --protocol scene-wrong-stereo --count 40 --seed 0 $(THREE)
of_scene_image        = --protocol scene-image --count 10 --seed 0 $(THREE)
of_mix-clean      = --protocol paper,incomplete,L1,sweep --count 32 --seed 3 $(FOUR)
of_mix-l2like     = --protocol L2,L2-wave,L2-gp --count 32 --seed 3 $(FOUR)
of_mix-l3like     = --protocol L3,L3-gp --count 26 --seed 3 $(FOUR)
of_mix-wrong      = --protocol wrong --count 128 --seed 3 $(FOUR)
of_mix-depth      = --protocol depth-camera --count 32 --seed 3 $(FOUR)
of_mix-pointer    = --protocol pointer --count 26 --seed 3 $(FOUR)
of_mix-ultrasound = --protocol ultrasound --count 26 --seed 3 $(FOUR)
of_mix-laser      = --protocol laser --count 24 --seed 3 $(FOUR)
of_fresh          = --protocol structured-light,stereo,photogrammetry,covered,moving --count 16 --seed 3 $(FOUR)
of_traced         = --protocol tracing --count 24 --seed 3 $(FOUR)
of_traced-named   = $(of_traced)
of_few-pointer    = --protocol pointer-50 --count 24 --seed 5 $(FOUR)
of_few-ultrasound = --protocol ultrasound-4 --count 24 --seed 5 $(FOUR)
of_few-femora     = --protocol L3 --bones femur --split test --count 96 --seed 5

# Lists of a sensor that the user names
sensor_mix-depth = depth_camera
sensor_mix-pointer = pointer
sensor_mix-ultrasound = ultrasound
sensor_mix-laser = laser
sensor_traced-named = pointer
sensor_few-pointer = pointer
sensor_few-ultrasound = ultrasound

# Tables that `gapr benchmark` writes, that benchmarks/trust.py makes of its records, and of scripts
BENCHMARKS := one_sided clean scenes scene_stereo scene_noisy scene_joint scene_table scene_variants scene_wrong scene_wrong_stereo scene_image \
              looks looks_joint looks_wrong
MIX        := $(addprefix mix-,l3like wrong ultrasound pointer depth laser l2like clean)
TRACED     := traced traced-named
FEW        := $(addprefix few-,pointer ultrasound femora)
SCRIPTS    := other_subjects similar short_scans streams streams_other_subjects damage damage_camera damage_camera_described damage_layer \
              guidance hollow unknowable check_points flat_ends proposals proposals_clean viewpoint viewpoint_wrong
made_by_other_subjects    = other_subjects.py --anatomy $(ANATOMY) --split test --out $(OUT)/other_subjects
made_by_similar           = other_subjects.py --anatomy $(ANATOMY) --split test --bones femur,tibia,pelvis --count 0 --mirrored 0 --sides 0 --similar 270 --out $(OUT)/similar
made_by_short_scans       = short_scans.py --anatomy $(ANATOMY) --split test --count 20
made_by_streams           = tracking.py --anatomy $(ANATOMY) --split test --count 1
made_by_streams_other_subjects = tracking.py --anatomy $(ANATOMY) --split test --count 10 --bones femur,tibia --kinds 'another subject'\''s bone'
made_by_damage            = damage.py --anatomy $(ANATOMY) --split test --count 24 --others 12 --out $(OUT)/damage
made_by_damage_camera     = $(made_by_damage)_camera --damages 'wrong range,patches'
made_by_damage_camera_described = $(made_by_damage)_described --damages 'wrong range,patches' --sensor depth_camera
made_by_damage_layer      = $(made_by_damage)_layer --damages 'even layer'
made_by_guidance          = guidance.py --anatomy $(ANATOMY) --count 4 --most 40 --plot $(OUT)/figures/guidance.png
made_by_hollow            = hollow.py --anatomy $(ANATOMY) --split test --count 4
made_by_unknowable        = unknowable.py --count 8
made_by_check_points      = check_points.py --anatomy $(ANATOMY) --split test --count 12
made_by_flat_ends         = flat_ends.py --anatomy $(ANATOMY) --split test --count 24
made_by_proposals         = proposals.py --pairs $(OUT)/pairs/one_sided --limit 16
made_by_proposals_clean   = proposals.py --pairs $(OUT)/pairs/clean --limit 16
SEEN                      := scenes scene_stereo scene_joint scene_table
made_by_viewpoint         = viewpoint.py --pairs $(SEEN:%=$(OUT)/pairs/%) --every 3
WRONG                     := scene_wrong scene_wrong_stereo
made_by_viewpoint_wrong   = viewpoint.py --pairs $(WRONG:%=$(OUT)/pairs/%) --ways inferred
made_by_mix               = trust.py $(MIX:%=$(OUT)/bench/%)
made_by_mix_fresh         = trust.py $(OUT)/bench/fresh
made_by_tracing           = trust.py $(TRACED:%=$(OUT)/bench/%)
made_by_few               = trust.py $(FEW:%=$(OUT)/bench/%)
made_by_real_pieces       = real.py $(REAL:%=--real %)
made_by_real_pieces_described = $(made_by_real_pieces) --sensor depth_camera

ALL  := $(BENCHMARKS) mix mix_fresh tracing few $(SCRIPTS)
done  = $(OUT)/done/$(1)

.PHONY: all list real publish $(ALL)
.SECONDARY:
all: $(ALL)
list: ; @echo $(ALL) real
publish: ; cp $(OUT)/figures/*.png docs/figures/
real: $(call done,real_pieces) $(call done,real_pieces_described)
$(ALL): %: $(call done,%)

$(call done,mix): $(MIX:%=$(OUT)/bench/%/table.md)
$(call done,mix_fresh): $(OUT)/bench/fresh/table.md
$(call done,tracing): $(TRACED:%=$(OUT)/bench/%/table.md)
$(call done,few): $(FEW:%=$(OUT)/bench/%/table.md)
$(call done,proposals): $(OUT)/pairs/one_sided.txt
$(call done,proposals_clean): $(OUT)/pairs/clean.txt
$(call done,viewpoint): $(SEEN:%=$(OUT)/pairs/%.txt)
$(call done,viewpoint_wrong): $(WRONG:%=$(OUT)/pairs/%.txt)

$(OUT)/pairs/%.txt:
	@mkdir -p $(@D)
	$(GAPR) make-pairs $(of_$*) --anatomy $(ANATOMY) --out $(OUT)/pairs/$* > $@.part
	@mv $@.part $@

$(OUT)/bench/%/table.md: $(OUT)/pairs/%.txt
	$(GAPR) benchmark --pairs $(OUT)/pairs/$* --methods gapr --out $(OUT)/bench/$* --jobs 1 $(sensor_$*:%=--set sensor.kind=%)

$(BENCHMARKS:%=$(OUT)/done/%): $(OUT)/done/%: $(OUT)/bench/%/table.md
	$(PUBLISH) $* $(OUT)/bench/$*
	@mkdir -p $(@D) && touch $@

$(OUT)/done/%:
	@mkdir -p $(@D) $(OUT)/printed $(OUT)/figures
	python benchmarks/$(strip $(made_by_$*)) > $(OUT)/printed/$*.md
	$(PUBLISH) $* $(OUT)/printed/$*.md --command "python benchmarks/$(strip $(made_by_$*))"
	@touch $@
