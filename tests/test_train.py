"""Ray casting against known answers, the loss, and a training that can stop anywhere."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from jcr.errors import InputError
from jcr.reconstruct.dust3r.network import Dust3r, Features, Pointmap
from jcr.reconstruct.dust3r.weights import load_weights
from jcr.simulate.capture import SimulateOptions, simulate
from jcr.train import curves
from jcr.train import train as training
from jcr.train.loss import attention_miss, confident_regression, true_attention
from jcr.train.options import TrainOptions
from jcr.train.raycast import Counts, Solids, first_hits, is_blocked
from jcr.train.scenes import (
    SceneOptions,
    Views,
    disguised,
    draw_views,
    pairs_of,
    points_in_camera,
    seen_by,
)
from jcr.train.textures import SIDE, TEXELS, make_textures, sample
from jcr.train.train import Training, train, true_points
from jcr.train.validate import area_under_curve, capture_views, pair_errors, summary

SMALL = SceneOptions(width=64, height=48, views=3, boxes=3, superquadrics=2, lathes=1)


def solids(*rows: tuple[tuple, tuple, tuple]) -> Solids:
    """Upright solids of one view, given as origin, size and shape, and a room of 5 m to all sides."""
    origin, size, shape = zip(*rows, ((0, 0, 0), (5, 5, 5), (0, 0)), strict=True)
    turn = torch.eye(3).expand(1, len(rows) + 1, 3, 3)
    return Solids(turn, *(torch.tensor([x], dtype=torch.float32) for x in (origin, size, shape)))


def rays(origin: list, direction: list) -> tuple[torch.Tensor, ...]:
    return tuple(torch.tensor([x], dtype=torch.float32).mT for x in (origin, direction))


def test_rays_meet_a_box_and_the_walls_behind_it():
    scene = solids(((0, 0, 0.1), (0.2, 0.3, 0.1), (0, 0)))
    hits = first_hits(
        scene,
        Counts(1, 0, 0),
        *rays([[0, 0, 2], [2, 0, 0.1], [1, 0, 2]], [[0, 0, -2], [-1, 0, 0], [0, 0, -1]]),
    )
    torch.testing.assert_close(hits.distance, torch.tensor([[0.9, 1.8, 7.0]]))
    assert hits.solid.tolist() == [[0, 0, 1]]
    torch.testing.assert_close(hits.normal_in_solid[0].mT, torch.tensor([[0, 0, 1.0], [1, 0, 0], [0, 0, 1]]))


def test_rays_meet_a_sphere_where_the_quadratic_equation_says():
    generator = torch.Generator().manual_seed(0)
    eye, center, radius = torch.tensor([0.5, -0.8, 0.6]), torch.tensor([0.1, 0.0, 0.05]), 0.12
    aim = center + 0.3 * (torch.rand(400, 3, generator=generator) - 0.5)
    d = aim - eye
    scene = solids((tuple(center.tolist()), (radius,) * 3, (0, 0)))
    hits = first_hits(scene, Counts(0, 1, 0), eye[None, :, None], d.mT[None])
    a, b, c = (d * d).sum(1), d @ (eye - center), (eye - center).square().sum() - radius**2
    inside = b * b - a * c
    met = hits.solid[0] == 0
    # Within a hundredth of the radius of grazing it, either answer will do.
    clear = (inside / a - 0).abs() > 0.02 * radius**2
    assert torch.equal(met[clear], (inside > 0)[clear]) and 100 < met.sum() < 300
    t = (-b - inside.clamp(min=0).sqrt()) / a
    torch.testing.assert_close(hits.distance[0][met & clear], t[met & clear], atol=2e-3, rtol=0)
    outward = (eye + t[:, None] * d - center) / radius
    cosine = (hits.normal_in_solid[0].mT * outward).sum(1)
    assert cosine[met & clear].min() > 0.995


def test_superquadrics_lie_between_a_sphere_and_a_box():
    scene = solids(*(((0, 0, 0), (0.1, 0.1, 0.1), (level, level)) for level in (0, 1, 2)))
    # Along the diagonal the surface is where 3 x^p = 1.
    diagonal = torch.tensor([[1.0, 1.0, 1.0]])
    for number, power in enumerate((2, 4, 8)):
        alone = Solids(*(x[:, [number, 3]] for x in scene))
        hits = first_hits(alone, Counts(0, 1, 0), diagonal[..., None], -diagonal[..., None])
        assert hits.distance.item() == pytest.approx(1 - 0.1 * 3 ** (-1 / power), abs=1e-4)


def test_an_open_mug_shows_its_floor_and_a_closed_can_its_lid():
    down = rays([[0.01, 0, 1], [1, 0, 0.05]], [[0, 0, -1], [-1, 0, 0]])
    for hollow, distance in ((1, 1.0), (0, 0.9)):
        hits = first_hits(solids(((0, 0, 0), (0.03, 0.05, 0.1), (hollow, 0))), Counts(0, 0, 1), *down)
        # The wall is half way between both radii at half the height.
        torch.testing.assert_close(hits.distance, torch.tensor([[distance, 0.96]]))
    normal = hits.normal_in_solid[0, :, 1]
    torch.testing.assert_close(normal, torch.tensor([0.1, 0, -0.02]) / np.hypot(0.1, 0.02), atol=1e-5, rtol=0)


def test_a_ball_throws_its_shadow_where_the_lamp_cannot_see():
    scene = solids(((0, 0, -0.02), (1, 1, 0.02), (0, 0)), ((0, 0, 0.5), (0.1, 0.1, 0.1), (0, 0)))
    lamp = torch.tensor([0.0, 0.0, 1.0])
    # From 1 m high, a ball of 0.1 m at half the height covers sin⁻¹(0.1/0.5) around the vertical: 0.204 m.
    on_table = torch.tensor([[0.0, 0, 1e-3], [0.19, 0, 1e-3], [0.22, 0, 1e-3]])
    blocked = is_blocked(scene, Counts(1, 1, 0), on_table.mT[None], (lamp - on_table).mT[None])
    assert blocked.tolist() == [[True, True, False]]


@pytest.fixture(scope="module")
def views() -> Views:
    generator = torch.Generator().manual_seed(7)
    textures = make_textures(6, generator)
    return draw_views(4, SceneOptions(views=3), textures, generator)


def test_what_one_view_shows_the_other_shows_there_or_hides(views: Views):
    first, second = pairs_of(views, SceneOptions(views=3))
    assert 6 <= len(first) <= 24 and set((first // 3 - second // 3).tolist()) == {0}
    _, moved = true_points(views, first, second)
    x, y, z = moved.unbind(-1)
    focal = views.focal_px[first, None, None]
    column, row = (focal * x / z + 63.5).round().long(), (focal * y / z + 47.5).round().long()
    inside = (z > 0) & (column >= 0) & (column < 128) & (row >= 0) & (row < 96)
    there = views.depth[first[:, None, None], row.clamp(0, 95), column.clamp(0, 127)]
    # A point may hide behind a surface of the other view, and never floats before it; edges are a pixel wide.
    before = (z < 0.97 * there)[inside].float().mean()
    same = ((z - there).abs() < 0.02 * there)[inside].float().mean()
    assert before < 0.03 and 0.4 < same < 0.995
    assert torch.equal(seen_by(views, second, first)[0], inside & ((z - there).abs() < 0.02 * z))


def test_mirrored_views_are_of_a_world_that_can_be(views: Views):
    other = disguised(views, 3, torch.Generator().manual_seed(0))
    mirrored = (other.depth != views.depth).flatten(1).any(1)
    assert 0 < mirrored.sum() < len(mirrored)
    assert torch.equal(mirrored, mirrored[::3].repeat_interleave(3))
    torch.testing.assert_close(torch.linalg.det(other.world_from_camera), torch.ones(len(mirrored)))
    torch.testing.assert_close(other.images.sum((1, 2, 3)), views.images.sum((1, 2, 3)))
    # What one view shows the other shows too, as before, at the mirrored pixel.
    first, second = pairs_of(views, SceneOptions(views=3))
    kept, turned = ((mirrored[first] == x).nonzero()[:, 0] for x in (False, True))
    seen, there = (seen_by(x, first, second)[0] for x in (other, views))
    assert torch.equal(seen[kept], there[kept]) and seen[turned].float().mean() > 0.2
    # A pixel of the other view may round to its neighbour.
    assert (seen[turned].flip(-1) != there[turned]).float().mean() < 5e-3


def test_views_differ_as_little_as_their_light_where_they_see_the_same(views: Views):
    first, second = pairs_of(views, SceneOptions(views=3))
    seen, pixel = seen_by(views, first, second, tolerance=0.005)
    column, row = pixel.round().long().unbind(-1)
    there = views.images[second[:, None, None], :, row.clamp(0, 95), column.clamp(0, 127)]
    here = views.images[first].permute(0, 2, 3, 1)
    same = (there - here)[seen].abs().mean()
    shuffled = here[seen][torch.randperm(int(seen.sum()), generator=torch.Generator().manual_seed(0))]
    assert same < 0.5 * (there[seen] - shuffled).abs().mean()
    assert views.images.abs().max() <= 1 and views.images.std() > 0.1


def test_the_seed_decides_everything():
    def made(seed: int) -> Views:
        generator = torch.Generator().manual_seed(seed)
        return draw_views(2, SMALL, make_textures(2, generator), generator)

    one, again, other = made(1), made(1), made(2)
    assert all(torch.equal(a, b) for a, b in zip(one, again, strict=True))
    assert not torch.equal(one.depth, other.depth)
    at_once = replace(SMALL, views_at_once=4)
    generator = torch.Generator().manual_seed(1)
    together = draw_views(2, at_once, make_textures(2, generator), generator)
    torch.testing.assert_close(together.depth, one.depth)


def test_nothing_is_drawn_on_another_device_than_the_generator_is_on(monkeypatch: pytest.MonkeyPatch):
    class Elsewhere(torch.Generator):
        """A generator of the device that computes shapes alone; what is mixed with the CPU's raises there."""

        device = torch.device("meta")

    for name in ("rand", "randn", "randint"):
        made = getattr(torch, name)
        monkeypatch.setattr(torch, name, lambda *sizes, generator, made=made, **rest: made(*sizes, **rest))
    textures = torch.empty(2 * TEXELS, 3, device="meta")
    found = draw_views(2, SMALL, textures, Elsewhere())
    first = torch.empty(5, dtype=torch.long, device="meta")
    seen = seen_by(found, first, first, stride=4)
    loss, _ = confident_regression(
        tuple(Pointmap(x, x[..., 0]) for x in true_points(found, first, first)),
        true_points(found, first, first),
        0.2,
    )
    for x in (*found, *seen, true_attention(*seen, (64, 48), 16), loss):
        assert x.device.type == "meta"


def test_textures_tile_and_blur_with_the_size_of_a_pixel():
    textures = make_textures(6, torch.Generator().manual_seed(0))
    assert textures.shape == (6 * TEXELS, 3)
    number, along = torch.arange(6).repeat_interleave(40), torch.rand(240)
    for uv, other in (
        (torch.stack([torch.zeros(240), along], 1), torch.stack([torch.ones(240), along], 1)),
        (torch.stack([along, along - 1], 1), torch.stack([along + 2, along], 1)),
    ):
        one = torch.ones(240)
        torch.testing.assert_close(
            sample(textures, number, uv, one), sample(textures, number, other, one), atol=1e-3, rtol=0
        )
    uv = torch.rand(240, 2)
    fine, coarse = (sample(textures, number, uv, torch.full((240,), size)) for size in (1.0, float(SIDE)))
    assert coarse.abs().max() < 1e-5 < 0.1 < fine.std()


def pointmaps(views: Views, scale: float, confidence: float) -> tuple[tuple, tuple]:
    true = true_points(views, *pairs_of(views, SceneOptions(views=3)))
    return tuple(Pointmap(scale * x, torch.full_like(x[..., 0], confidence)) for x in true), true


def test_the_loss_is_zero_at_the_truth_whatever_its_scale(views: Views):
    for scale in (1.0, 0.2, 30.0):
        found, true = pointmaps(views, scale, 1.0)
        objective, distance = confident_regression(found, true, alpha=0.2)
        assert abs(objective) < 1e-5 and distance < 1e-5
    bent = tuple(view._replace(points=view.points * torch.tensor([1, 1, 1.1])) for view in found)
    _, off = confident_regression(bent, true, alpha=0.2)
    bent = tuple(view._replace(points=5 * view.points) for view in bent)
    _, scaled = confident_regression(bent, true, alpha=0.2)
    assert 0.01 < off < 0.1 and scaled == pytest.approx(float(off), rel=1e-5)


def test_the_best_confidence_is_alpha_over_the_error(views: Views):
    found, true = pointmaps(views, 1.0, 1.0)
    off = tuple(view._replace(points=view.points * torch.tensor([1, 1.05, 1.0])) for view in found)
    _, distance = confident_regression(off, true, alpha=0.2)
    candidates = float(0.2 / distance) * torch.tensor([0.5, 1.0, 2.0])
    objective = [
        float(
            confident_regression(tuple(v._replace(confidence=c + 0 * v.confidence) for v in off), true, 0.2)[
                0
            ]
        )
        for c in candidates
    ]
    assert objective[1] == min(objective)


def test_attention_is_told_where_the_same_points_are(views: Views):
    every = torch.arange(len(views.depth))
    alone = true_attention(*seen_by(views, every, every, stride=4), (128, 96), 16)
    torch.testing.assert_close(alone, torch.eye(48).expand(len(every), 48, 48))
    first, second = pairs_of(views, SceneOptions(views=3))
    seen, pixel = seen_by(views, first, second, stride=4)
    share = true_attention(seen, pixel, (128, 96), 16)
    torch.testing.assert_close(share.sum((1, 2)) / 48, seen.float().mean((1, 2)))
    network = training.new_network(TrainOptions(Path(), embed=48, encoder_depth=1, decoder_depth=1))
    attention = network.dec_blocks[0].cross_attn
    tokens = torch.randn(len(first), 48, 48)
    upright = torch.stack([torch.ones(48, 2, 2), torch.zeros(48, 2, 2)])
    # Untrained attention looks everywhere alike: log 48 nats off.
    miss = attention_miss(attention, (tokens, tokens, upright, upright), share)
    assert miss.item() == pytest.approx(np.log(48), abs=0.1)


def test_what_is_asked_for_matches_is_what_is_taught(views: Views):
    network = training.new_network(TrainOptions(Path(), embed=48, encoder_depth=1, decoder_depth=2, patch=16))
    features = network.encode(views.images[:4])
    seen: list[tuple[torch.Tensor, ...]] = []
    attention = network.dec_blocks[1].cross_attn
    hook = attention.register_forward_pre_hook(lambda _, args: seen.append(args))
    network.decode(features, features)
    hook.remove()
    there, back = network.matching_attention(features, features, 1)
    torch.testing.assert_close(there, attention.matching_scores(*seen[0]).softmax(-1).mean(1))
    torch.testing.assert_close(back, attention.matching_scores(*seen[1]).softmax(-1).mean(1))
    torch.testing.assert_close(there.sum(-1), torch.ones(4, 48))


def test_perfect_predictions_have_no_error_and_turned_ones_the_angle(views: Views):
    first, second = pairs_of(views, SceneOptions(views=3))

    class Perfect(Dust3r):
        """Answers with the truth of the pairs in the order in which it is asked."""

        def __init__(self, turn: torch.Tensor) -> None:
            super().__init__(enc_embed_dim=48, enc_depth=0, dec_embed_dim=64, dec_depth=0)
            self.turn, self.asked = turn, 0

        def encode(self, images: torch.Tensor, many_pairs: bool = False) -> Features:
            return Features(torch.zeros(len(images), 1, 1), (1, 1))

        def decode(self, features1: Features, features2: Features) -> tuple[Pointmap, Pointmap]:
            rows = slice(self.asked, self.asked + len(features1.tokens))
            self.asked += len(features1.tokens)
            x, y = true_points(views, first[rows], second[rows])
            return Pointmap(3 * x, x[..., 0]), Pointmap(3 * y @ self.turn.mT, x[..., 0])

    none = pair_errors(Perfect(torch.eye(3)), views, first, second)
    assert max(x.max() for x in none) < 1e-3
    ten = torch.linalg.matrix_exp(torch.tensor([[0, -1.0, 0], [1, 0, 0], [0, 0, 0]]) * np.radians(10))
    turned = pair_errors(Perfect(ten.float()), views, first, second)
    np.testing.assert_allclose(turned.rotation_deg, 10, atol=0.01)
    assert summary(turned)["rotation_deg"] == 10.0 and summary(turned)["auc5"] == 0
    assert area_under_curve(np.array([0.0, 5.0, 10.0, 20.0]), 10.0) == pytest.approx((1 + 0.5) / 4)


@pytest.mark.gl
def test_simulated_captures_are_read_as_the_same_kind_of_views(tmp_path: Path):
    views = capture_views(simulate(tmp_path / "capture", SimulateOptions(images=3)), (128, 96))
    n = len(views.depth)
    first, second = (~torch.eye(n, dtype=torch.bool)).nonzero().T
    seen, _ = seen_by(views, first, second, stride=4, tolerance=0.01)
    assert seen.float().mean() > 0.3 and views.images.std() > 0.1
    assert points_in_camera(views).shape == (n, 96, 128, 3)


TINY = TrainOptions(
    Path(),
    steps=20,
    scenes_per_step=2,
    scene=replace(SMALL, least_overlap=0.1),
    embed=48,
    heads=3,
    encoder_depth=1,
    decoder_depth=2,
    textures=4,
    pool_steps=2,
    replays=2,
    bank_pools=2,
    warmup=2,
    muon_rate=1e-2,
    adam_rate=1e-2,
    save_every=3,
    validate_every=1000,
)


def test_a_scene_is_seen_in_every_replay_and_then_no_more():
    options = replace(TINY, pool_steps=3, replays=2)
    drawn = Training(options)
    colors = [
        set(drawn.views(step).images[::3].double().sum((1, 2, 3)).round(decimals=2).tolist())
        for step in range(7)
    ]
    once, twice, then = set().union(*colors[:3]), set().union(*colors[3:6]), colors[6]
    assert len(once) == 6 and once == twice and not once & then


def test_a_shared_decoder_gives_both_orders_at_once(views: Views):
    network = training.new_network(replace(TINY, precision="float32"))
    first, second = torch.tensor([0, 4]), torch.tensor([1, 5])
    images = views.images[:, :, ::2, ::2]
    with torch.no_grad():
        both = training.predict(network, images, first, second, both_orders=True)
        apart = training.predict(network, images, torch.cat([first, second]), torch.cat([second, first]))
    for found, expected in zip(both, apart, strict=True):
        torch.testing.assert_close(found.points, expected.points)
        torch.testing.assert_close(found.confidence, expected.confidence)
    of_both = training.new_network(replace(TINY, shared_decoder=False))
    assert of_both.dec_blocks2 is not of_both.dec_blocks


def test_stopping_and_going_on_gives_the_same_bits(tmp_path: Path):
    whole = Training(replace(TINY, out=tmp_path))
    for _ in range(5):
        whole.advance()
    stopped = Training(replace(TINY, out=tmp_path))
    for _ in range(2):
        stopped.advance()
    stopped.save()
    again = Training(replace(TINY, out=tmp_path))
    again.load()
    for _ in range(3):
        again.advance()
    for key, value in whole.network.state_dict().items():
        assert torch.equal(value, again.network.state_dict()[key])
        assert torch.equal(whole.averaged[key], again.averaged[key])
    with pytest.raises(InputError, match="another embed; use a new folder"):
        Training(replace(TINY, out=tmp_path, embed=96)).load()


def test_twenty_steps_lower_the_loss_and_leave_weights_that_jcr_reads(tmp_path: Path):
    options = replace(TINY, out=tmp_path / "run")
    before = Training(options)
    train(options)
    after = Training(options)
    after.load()
    assert after.step == 20

    def held_out(training_: Training) -> float:
        views = training_.views(1000)
        first, second = pairs_of(views, options.scene)
        with torch.no_grad():
            found = training.predict(training_.network.eval(), views.images, first, second)
            return float(confident_regression(found, true_points(views, first, second), 0.2)[1])

    assert held_out(after) < 0.9 * held_out(before)
    loaded = load_weights(tmp_path / "run" / "weights")
    assert loaded.size == (64, 48) and loaded.licence == "Apache-2.0" and loaded.matching_block == 1
    for key, value in loaded.network.state_dict().items():
        torch.testing.assert_close(value, after.averaged[key], atol=2e-3, rtol=2e-3)
    lines = (tmp_path / "run" / "log.jsonl").read_text().splitlines()
    assert '"step": 20' in lines[-1] and "held-out scenes" in lines[-1]
    curves.draw(tmp_path / "curves.png", [tmp_path / "run"])
    with Image.open(tmp_path / "curves.png") as picture:
        assert picture.width > 1000
    # From shipped weights, in a new folder.
    going_on = Training(replace(options, out=tmp_path / "on", from_weights=tmp_path / "run" / "weights"))
    assert held_out(going_on) < 0.9 * held_out(before)
