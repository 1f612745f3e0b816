from __future__ import annotations

import pytest

from slamhive.domain.configuration import Configuration, VariantStep

HALF = VariantStep("resolution", ("cam0",), {"scale": 0.5})
SLOW = VariantStep("rate", ("cam0",), {"hz": 10.0})


def test_configurations_without_steps_keep_the_hash_they_were_stored_under():
    stored = "9ff36ae00df0027e9e1832fe90428d980c6001cafecae1add3f26530e905ef1e"
    assert Configuration("a", "b", {"x": 1}).content_hash == stored
    assert Configuration("a", "b", {"x": 1}, variant=()).content_hash == stored


def test_sensors_are_a_set_and_options_have_no_order():
    one = VariantStep("fog", ("cam1", "cam0", "cam1"), {"b": 1, "a": 2.0})
    other = VariantStep("fog", ("cam0", "cam1"), {"a": 2.0, "b": 1})
    assert one == other
    assert hash(one) == hash(other)
    assert one.content == other.content
    assert str(one) == "fog of cam0, cam1 (a 2, b 1)"


def test_the_brief_form_has_numbers_first_as_its_end_may_be_cut_off():
    step = VariantStep("resolution", ("cam0",), {"interpolation": "area", "scale": 0.25})
    assert step.brief == "resolution scale=0.25 interpolation=area"


@pytest.mark.parametrize(
    "variant",
    [
        (HALF,),
        (SLOW,),
        (HALF, SLOW),
        (SLOW, HALF),
        (VariantStep("resolution", ("cam1",), {"scale": 0.5}),),
        (VariantStep("resolution", ("cam0",), {"scale": 0.6}),),
        (VariantStep("resolution", ("cam0",), {"scale": 1}),),
        (VariantStep("resolution", ("cam0",), {"scale": 1.0}),),
    ],
    ids=str,
)
def test_steps_and_their_order_are_part_of_the_identity(variant):
    others = [(), (HALF, HALF), (HALF, SLOW, SLOW)]
    hashes = {Configuration("a", "b", {}, variant=entry).content_hash for entry in [*others, variant]}
    assert len(hashes) == 4


def test_order_and_type_tell_steps_apart():
    variants = [(HALF, SLOW), (SLOW, HALF), (VariantStep("x", (), {"k": 1}),), (VariantStep("x", (), {"k": True}),)]
    assert len({Configuration("a", "b", {}, variant=variant).content_hash for variant in variants}) == 4
