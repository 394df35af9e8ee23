"""Metrics against closed forms, published values and scikit-image; splits that leak are refused."""

import hashlib
from datetime import UTC, datetime, timedelta, timezone

import numpy as np
import pytest
from tiny_diffusion import random_lpips, write_lpips_parts

from seasonscapes.cameras.observation import Observation, webcam_of
from seasonscapes.cameras.pinhole import Camera
from seasonscapes.errors import InputError
from seasonscapes.evaluation.lpips import (
    NETWORK_URL,
    PUBLISHED,
    join_lpips,
    load_lpips,
    lpips_of,
    lpips_sources,
    missing_lpips,
)
from seasonscapes.evaluation.masks import reference_mask, terrain_mask
from seasonscapes.evaluation.metrics import (
    angle_deg,
    colour_angle_deg,
    delta_e2000,
    flip,
    flip_map,
    psnr_db,
    score,
    ssim,
    ssim_map,
    whole_windows,
)
from seasonscapes.evaluation.splits import (
    LeakageError,
    PictureUse,
    check_no_leakage,
    content_hash,
    file_content_hash,
    held_out_times,
    held_out_views,
    observation_hash,
    picture_use,
)
from seasonscapes.evaluation.surfaces import albedo_error, shadow_iou
from seasonscapes.evaluation.tables import by_class, by_distance, drop, summary, table_lines
from seasonscapes.images import linear_from_srgb, write_png8

NOON = datetime(2024, 9, 18, 11, tzinfo=UTC)


@pytest.fixture(scope="module")
def pair():
    from skimage.data import astronaut

    truth = astronaut()[100:228, 120:280].astype(np.float64) / 255.0
    noise = np.random.default_rng(3).normal(0.0, 0.05, truth.shape)
    return truth, np.clip(truth + noise, 0.0, 1.0)


@pytest.fixture(scope="module")
def mask(pair):
    rows, columns = np.indices(pair[0].shape[:2])
    return (rows - 70) ** 2 + (columns - 80) ** 2 < 50**2


# ---------------------------------------------------------------------------------------------- pictures


def test_psnr_closed_form():
    truth = np.full((8, 9, 3), 0.5)
    assert psnr_db(truth, truth + 0.1) == pytest.approx(20.0)
    assert psnr_db(truth, truth) == np.inf


def test_psnr_and_ssim_as_scikit_image(pair):
    from skimage.metrics import peak_signal_noise_ratio, structural_similarity

    assert psnr_db(*pair) == pytest.approx(peak_signal_noise_ratio(*pair, data_range=1.0), abs=1e-9)
    theirs = structural_similarity(
        *pair, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1.0, channel_axis=2
    )
    # scikit-image too leaves out the frame's rim of five pixels: windows wholly within the frame.
    assert ssim(*pair) == pytest.approx(theirs, abs=1e-9)


def test_ssim_of_constants_is_luminance_term():
    """Two constant pictures leave only (2ab + C1) / (a² + b² + C1) of Wang et al. 2004, eq. 6."""
    a, b, c1 = 0.4, 0.6, 0.01**2
    assert ssim(np.full((20, 20, 3), a), np.full((20, 20, 3), b)) == pytest.approx(
        (2 * a * b + c1) / (a * a + b * b + c1)
    )


def test_valid_mode_does_not_see_beyond_the_mask(pair, mask):
    truth, picture = pair
    spoilt = np.where(mask[..., None], picture, np.random.default_rng(0).random(picture.shape))
    spoilt[0, 0] = np.nan
    before, after = score(truth, picture, mask), score(truth, spoilt, mask)
    assert before.record() == pytest.approx(after.record(), abs=1e-12)
    assert before.mask_share == pytest.approx(mask.mean())


def test_paper_mode_flatters_by_the_mask_share(pair, mask):
    """Masked pixels count as perfect: −10 log10(share) dB more, whatever the picture."""
    truth, picture = np.full((40, 50, 3), 0.5), np.full((40, 50, 3), 0.6)
    half = np.zeros((40, 50), bool)
    half[:10] = True
    valid, paper = (psnr_db(truth, picture, half, mode=mode) for mode in ("valid", "paper"))
    assert paper - valid == pytest.approx(-10.0 * np.log10(0.25))
    assert ssim(*pair, mask, mode="paper") > ssim(*pair, mask)
    assert flip(*pair, mask, mode="paper") < flip(*pair, mask)


def test_paper_mode_ssim_is_the_references_convolution(pair, mask):
    """Zero padding, 11 × 11 Gaussian of sigma 1.5, mean of the whole frame: written out here as plain sums."""
    from scipy.signal import convolve2d

    a, b = (each[:40, :48] * mask[:40, :48, None] for each in pair)
    taps = np.exp(-(np.arange(-5, 6) ** 2) / (2 * 1.5**2))
    window = np.outer(taps, taps) / taps.sum() ** 2

    def blur(x):
        return convolve2d(x, window, mode="same", boundary="fill")

    total = []
    for c in range(3):
        x, y = a[..., c], b[..., c]
        mx, my = blur(x), blur(y)
        vx, vy, vxy = blur(x * x) - mx**2, blur(y * y) - my**2, blur(x * y) - mx * my
        total.append(((2 * mx * my + 1e-4) * (2 * vxy + 9e-4) / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4))).mean())
    assert ssim(*(each[:40, :48] for each in pair), mask[:40, :48], mode="paper") == pytest.approx(
        np.mean(total), abs=1e-9
    )


def test_whole_windows_and_none():
    mask = np.zeros((30, 30), bool)
    mask[5:18, 5:17] = True
    assert whole_windows(mask).sum() == 3 * 2
    assert whole_windows(np.ones((30, 30), bool)).sum() == 20 * 20
    thin = np.zeros((30, 30), bool)
    thin[10:15] = True
    assert np.isnan(ssim(np.zeros((30, 30, 3)), np.ones((30, 30, 3)), thin))


def test_flip_extremes_and_order(pair):
    black, white = np.zeros((64, 64, 3)), np.ones((64, 64, 3))
    assert flip(black, black) == pytest.approx(0.0, abs=1e-6)
    # Black against white is near the largest error there is.
    assert flip(black, white) > 0.9
    assert 0.0 < flip(pair[0], 0.5 * (pair[0] + pair[1])) < flip(*pair) < 1.0
    assert flip_map(*pair).shape == pair[0].shape[:2]


def test_colour_angle_closed_form_and_exposure():
    assert angle_deg(np.array([[1.0, 0.0, 0.0]]), np.array([[1.0, 1.0, 0.0]])) == pytest.approx(45.0)
    assert np.isnan(angle_deg(np.zeros((3, 3)), np.ones((3, 3))))
    from seasonscapes.images import srgb_from_linear

    linear = np.random.default_rng(1).uniform(0.2, 0.9, (6, 7, 3))
    assert colour_angle_deg(srgb_from_linear(linear), srgb_from_linear(0.5 * linear)) == pytest.approx(0.0, abs=1e-3)


def test_score_refuses_what_is_no_picture(pair, mask):
    truth, picture = pair
    for arguments in [
        (truth, picture[:-1]),
        (truth, picture, mask[:-1]),
        (truth, picture, np.zeros_like(mask)),
        (truth, 255.0 * picture),
        (truth * np.nan, picture),
    ]:
        with pytest.raises(ValueError, match="score"):
            score(*arguments)
    with pytest.raises(ValueError, match="mode"):
        psnr_db(truth, picture, mode="flattering")


def test_colour_difference_of_greys_in_closed_form():
    """Between neutral colours CIEDE2000 is the difference of lightness over its weight S_L."""
    from seasonscapes.images import srgb_from_linear

    def lightness(y):
        return 116.0 * np.cbrt(y) - 16.0

    for one, other in ((0.18, 0.30), (0.5, 0.55)):
        pictures = [np.full((12, 12, 3), srgb_from_linear(np.array(y))) for y in (one, other)]
        middle = (lightness(one) + lightness(other)) / 2.0 - 50.0
        weight = 1.0 + 0.015 * middle**2 / np.sqrt(20.0 + middle**2)
        expected = abs(lightness(one) - lightness(other)) / weight
        assert delta_e2000(*pictures) == pytest.approx(expected, rel=1e-3)
        assert score(*pictures, colour_difference=True).delta_e2000 == pytest.approx(expected, rel=1e-3)
    black, white = np.zeros((12, 12, 3)), np.ones((12, 12, 3))
    assert delta_e2000(black, white) == pytest.approx(100.0, abs=0.01)
    half = np.arange(12)[:, None] < np.full(12, 6)
    assert delta_e2000(black, np.where(half[..., None], white, black), ~half) == 0.0
    assert score(black, white).delta_e2000 is None


# ---------------------------------------------------------------------------------------------- LPIPS


def lpips_by_modules(network, linear):
    """LPIPS written independently with modules of torch: AlexNet's layers as published, taken after each ReLU."""
    import torch
    from torch import nn

    features = nn.Sequential(
        nn.Conv2d(3, 64, kernel_size=11, stride=4, padding=2),
        nn.ReLU(),
        nn.MaxPool2d(kernel_size=3, stride=2),
        nn.Conv2d(64, 192, kernel_size=5, padding=2),
        nn.ReLU(),
        nn.MaxPool2d(kernel_size=3, stride=2),
        nn.Conv2d(192, 384, kernel_size=3, padding=1),
        nn.ReLU(),
        nn.Conv2d(384, 256, kernel_size=3, padding=1),
        nn.ReLU(),
        nn.Conv2d(256, 256, kernel_size=3, padding=1),
        nn.ReLU(),
    )
    features.load_state_dict({key.removeprefix("features."): value for key, value in network.items()})
    linears = [nn.Conv2d(value.shape[1], 1, 1, bias=False) for value in linear.values()]
    for layer, value in zip(linears, linear.values(), strict=True):
        layer.load_state_dict({"weight": value})

    def outputs(image):
        x = 2.0 * torch.tensor(image, dtype=torch.float32).permute(2, 0, 1)[None] - 1.0
        shift, scale = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
        x = (x - shift[None, :, None, None]) / scale[None, :, None, None]
        found = []
        for number, layer in enumerate(features):
            x = layer(x)
            if number in (1, 4, 7, 9, 11):
                found.append(x / (torch.sqrt(torch.sum(x**2, dim=1, keepdim=True)) + 1e-10))
        return found

    def measure(truth, picture):
        with torch.no_grad():
            layers = zip(outputs(truth), outputs(picture), linears, strict=True)
            return sum(float(linear((a - b) ** 2).mean()) for a, b, linear in layers)

    return measure


def test_lpips_equals_modules_of_torch(pair):
    weights = random_lpips()
    truth, picture = pair
    expected = lpips_by_modules(*weights)(truth, picture)
    assert expected > 0.01
    assert lpips_of(*weights)(truth, picture) == pytest.approx(expected, rel=1e-5)


def test_lpips_in_mode_paper_sees_pictures_from_0_to_1(pair):
    """The reference evaluation does not map them to [-1, 1] first; masked pixels are black."""
    measure = lpips_of(*random_lpips())
    truth, picture = pair
    mask = np.ones(truth.shape[:2], bool)
    mask[:10] = False
    by_hand = measure(*(0.5 + 0.5 * image * mask[..., None] for image in (truth, picture)))
    assert score(truth, picture, mask, mode="paper", lpips=measure).lpips == pytest.approx(by_hand, rel=1e-6)
    assert score(truth, picture, mask, lpips=measure).lpips != pytest.approx(by_hand, rel=1e-2)


def test_lpips_behaves_as_a_distance(pair):
    """With random weights: zero for equal pictures, symmetric, growing, and blind beyond the mask."""
    measure = lpips_of(*random_lpips())
    truth, picture = pair
    assert measure(truth, truth) == 0.0
    assert measure(truth, picture) == pytest.approx(measure(picture, truth), rel=1e-5)
    assert 0.0 < measure(truth, 0.5 * (truth + picture)) < measure(truth, picture)
    everything = np.ones(truth.shape[:2], bool)
    assert measure(truth, picture, everything) == pytest.approx(measure(truth, picture), rel=1e-5)
    assert score(truth, picture, lpips=measure).lpips == pytest.approx(measure(truth, picture), rel=1e-5)


def test_lpips_first_layer_by_hand():
    """With only the first layer's linear weights: the formula of the paper, eq. 1, on patches written out in numpy."""
    network, linear = random_lpips()
    for i in range(1, 5):
        linear[f"lin{i}.model.1.weight"] *= 0.0
    rng = np.random.default_rng(5)
    images = rng.random((2, 35, 35, 3))
    weight, bias = network["features.0.weight"].numpy(), network["features.0.bias"].numpy()

    def features(image):
        x = (2.0 * image - 1.0 - [-0.030, -0.088, -0.188]) / [0.458, 0.448, 0.450]
        x = np.pad(x, ((2, 2), (2, 2), (0, 0)))
        size = (x.shape[0] - 11) // 4 + 1
        found = np.empty((size, size, 64))
        for i in range(size):
            for j in range(size):
                patch = x[4 * i : 4 * i + 11, 4 * j : 4 * j + 11].transpose(2, 0, 1)
                found[i, j] = np.maximum((weight * patch).sum(axis=(1, 2, 3)) + bias, 0.0)
        return found / np.linalg.norm(found, axis=2, keepdims=True)

    apart = (features(images[0]) - features(images[1])) ** 2 @ linear["lin0.model.1.weight"].numpy().ravel()
    assert lpips_of(network, linear)(*images) == pytest.approx(apart.mean(), rel=1e-4)


def test_lpips_says_why_it_is_absent(tmp_path, monkeypatch):
    monkeypatch.delenv("SEASONSCAPES_LPIPS", raising=False)
    assert "SEASONSCAPES_LPIPS" in missing_lpips()
    assert "no such file" in missing_lpips(tmp_path / "none.safetensors")
    with pytest.raises(ValueError, match=r"features\.0"):
        lpips_of({}, {})


def test_lpips_parts_are_joined_and_give_the_same(tmp_path, pair):
    network, linear = random_lpips()
    alexnet, wheel, content = write_lpips_parts(tmp_path, network, linear)
    found = join_lpips(alexnet, wheel, tmp_path / "a.safetensors")
    assert found["linear_sha256"] == hashlib.sha256(content).hexdigest()
    assert lpips_sources(tmp_path / "a.safetensors") == {**found, "published": False}
    expected = lpips_of(network, linear)(*pair, None)
    assert load_lpips(tmp_path / "a.safetensors")(*pair, None) == expected
    (tmp_path / "alex.pth").write_bytes(content)
    assert join_lpips(alexnet, tmp_path / "alex.pth", tmp_path / "b.safetensors") == found
    assert (tmp_path / "a.safetensors").read_bytes() == (tmp_path / "b.safetensors").read_bytes()
    # A tenth of the whole network's size: only the convolutions are kept.
    assert (tmp_path / "a.safetensors").stat().st_size == pytest.approx(4 * (2_469_696 + 1152), abs=3000)


def test_published_weights_are_known_by_their_checksums():
    assert PUBLISHED["alexnet_sha256"].startswith("7be5be79")
    assert NETWORK_URL.endswith(f"-{PUBLISHED['alexnet_sha256'][:8]}.pth")


def test_lpips_names_the_file_that_holds_other_weights(tmp_path):
    import torch

    network, linear = random_lpips()
    alexnet, wheel, _ = write_lpips_parts(tmp_path, network, linear)
    output = tmp_path / "l.safetensors"
    for other in ({}, [1.0]):
        torch.save(other, tmp_path / "other.pth")
        with pytest.raises(InputError, match=r"other\.pth: .* 5 of 5 keys are missing; expected the key lin0"):
            join_lpips(alexnet, tmp_path / "other.pth", output)
    # The weights for VGG have the same names.
    torch.save(linear | {"lin0.model.1.weight": torch.zeros(1, 128, 1, 1)}, tmp_path / "vgg.pth")
    with pytest.raises(InputError, match=r"vgg\.pth: .*lin0.* has another shape; got \(1, 128, 1, 1\)"):
        join_lpips(alexnet, tmp_path / "vgg.pth", output)
    with pytest.raises(InputError, match=r"7be5be79\.pth: .* 5 of 5 keys are missing"):
        join_lpips(alexnet, alexnet, output)
    with pytest.raises(InputError, match=r"none\.pth: no such file"):
        join_lpips(tmp_path / "none.pth", wheel, output)
    del network["features.3.bias"]
    torch.save(network, alexnet)
    with pytest.raises(InputError, match=r"1 of 10 keys are missing; expected the key features\.3\.bias"):
        join_lpips(alexnet, wheel, output)
    wheel.write_bytes(wheel.read_bytes()[:200])
    torch.save(random_lpips()[0], alexnet)
    with pytest.raises(InputError, match=r"\.whl: damaged"):
        join_lpips(alexnet, wheel, output)
    assert not output.exists()


# ---------------------------------------------------------------------------------------------- masks


def test_land_mask_by_metric_depth():
    depth = np.array([[10.0, 60.0, 500.0, 9000.0, np.inf]])
    assert terrain_mask(depth).tolist() == [[False, True, True, True, False]]
    assert terrain_mask(depth, near_m=0.0, far_m=1000.0).tolist() == [[True, True, True, False, False]]
    with pytest.raises(ValueError, match="NaN"):
        terrain_mask(np.array([[np.nan]]))
    with pytest.raises(ValueError, match="near_m"):
        terrain_mask(depth, near_m=100.0, far_m=50.0)


def test_reference_mask_drops_sky_and_the_near():
    depth = np.tile(np.linspace(100.0, 10_000.0, 2000), (2, 1))
    depth[1] = np.inf
    mask = reference_mask(depth)
    assert not mask[1].any()
    kept = mask[0].mean()
    assert mask[0, -1]
    assert not mask[0, 0]
    # 45 % of the land are dropped, less the one bin of 128 that the index is off by.
    assert kept == pytest.approx(0.55, abs=0.02)
    assert not reference_mask(np.full((3, 3), np.inf)).any()


# ---------------------------------------------------------------------------------------------- land


def test_albedo_error_closed_form():
    truth = np.full((10, 10, 3), 0.4)
    error = albedo_error(truth, truth * 0.5)
    assert (error.mae, error.rmse) == pytest.approx((0.2, 0.2))
    assert error.psnr_db == pytest.approx(-20.0 * np.log10(0.2))
    assert error.scale == pytest.approx([2.0, 2.0, 2.0])
    assert (error.scale_invariant_mae, error.colour_angle_deg) == pytest.approx((0.0, 0.0), abs=1e-9)


def test_albedo_error_weighs_texels():
    truth, estimate = np.zeros((2, 3)), np.array([[0.1] * 3, [0.3] * 3])
    assert albedo_error(truth, estimate, np.array([3.0, 1.0])).mae == pytest.approx(0.15)
    assert albedo_error(truth, np.array([[0.1] * 3, [np.nan] * 3]), np.array([1.0, 0.0])).mae == pytest.approx(0.1)
    with pytest.raises(ValueError, match="weight"):
        albedo_error(truth, estimate, np.zeros(2))
    with pytest.raises(ValueError, match="finite"):
        albedo_error(truth, estimate * np.nan)


def test_shadow_iou_closed_form():
    lit = np.ones((4, 10))
    a, b = lit.copy(), lit.copy()
    a[:, :4], b[:, 2:6] = 0.0, 0.2
    assert shadow_iou(a, b) == pytest.approx(2 / 6)
    assert shadow_iou(a, a) == shadow_iou(lit, lit) == 1.0
    assert shadow_iou(a, b, np.arange(10) < np.full((4, 1), 4)) == pytest.approx(2 / 4)


# ---------------------------------------------------------------------------------------------- tables


def test_tables_by_class_and_distance():
    truth = np.full((2, 4, 3), 0.5)
    picture = truth.copy()
    picture[:, :2] += 0.1
    picture[:, 2:] += 0.01
    labels = np.tile([0, 0, 1, 1], (2, 1))
    rows = by_class(truth, picture, labels, {0: "rock", 1: "snow", 2: "lake"})
    assert [row["psnr_db"] for row in rows[:2]] == pytest.approx([20.0, 40.0])
    assert [row["share"] for row in rows] == [0.5, 0.5, 0.0]
    assert np.isnan(rows[2]["psnr_db"])
    far = by_distance(
        truth, picture, np.tile([500.0, 500.0, 3000.0, np.inf], (2, 1)), np.tile([True, True, True, False], (2, 1))
    )
    shares = {row["name"]: row["share"] for row in far}
    assert shares["0–1 km"] == pytest.approx(2 / 3)
    assert shares["2–4 km"] == pytest.approx(1 / 3)


def test_summary_counts_what_is_not_finite():
    told = summary([{"psnr_db": 20.0}, {"psnr_db": 30.0}, {"psnr_db": np.inf}])["psnr_db"]
    assert (told["n"], told["mean"], told["median"], told["std"]) == (3, 25.0, 25.0, 5.0)
    assert told["not_finite"] == 1


def test_drop_is_relative_and_positive_for_worse():
    assert drop(0.2, 0.25) == pytest.approx(0.25)
    assert drop(0.2, 0.15) == pytest.approx(-0.25)
    with pytest.raises(ValueError, match="more than 0"):
        drop(0.0, 0.1)


def test_table_lines():
    rows = [{"scene": "small", "psnr_db": 26.123}, {"scene": "large", "psnr_db": None}]
    assert table_lines(rows, digits=1) == ["scene  psnr_db", "small     26.1", "large        –"]
    assert table_lines(rows, markdown=True)[1] == "| ----- | ------: |"
    assert table_lines([]) == []


# ---------------------------------------------------------------------------------------------- splits


def test_held_out_views_keep_panoramas_together():
    names = ["a/0", "a/1", "b", "c/0", "c/1", "d"]
    for seed in range(5):
        paint, held = held_out_views(names, 2, seed=seed)
        assert sorted(paint + held) == sorted(names)
        assert not {webcam_of(n) for n in paint} & {webcam_of(n) for n in held}
        assert len({webcam_of(n) for n in held}) == 2
    with pytest.raises(ValueError, match="expected 1 to 3"):
        held_out_views(names, 4)


def test_held_out_hours_lie_between_used_ones():
    times = [NOON + timedelta(hours=h) for h in (3, 0, 1, 2, 4)]
    used, held = held_out_times(times, 2)
    assert held == (NOON + timedelta(hours=1), NOON + timedelta(hours=3))
    assert used[0] < held[0] < used[-1]
    for arguments in [(times, 1), (times[:1], 2), ([NOON, NOON], 2)]:
        with pytest.raises(ValueError, match="held_out_times"):
            held_out_times(*arguments)


def test_leaks_are_refused_by_webcam_and_time():
    paint = [PictureUse("a", NOON, "painting"), PictureUse("b/1", NOON, "guidance")]
    later = NOON + timedelta(hours=1)
    check_no_leakage([PictureUse("c", NOON, "evaluation"), PictureUse("a", later, "evaluation")], paint)
    zurich = NOON.astimezone(timezone(timedelta(hours=2)))
    with pytest.raises(LeakageError, match=r"a at 2024-09-18T11:00:00\+00:00 was used for painting"):
        check_no_leakage([PictureUse("a", zurich, "evaluation")], paint)
    with pytest.raises(LeakageError, match="guidance"):  # another view of the same panorama at the same instant
        check_no_leakage([PictureUse("b/2", NOON, "evaluation")], paint)
    with pytest.raises(LeakageError, match="same webcam, at"):
        check_no_leakage([PictureUse("a", later, "evaluation")], paint, kind="view")
    with pytest.raises(LeakageError, match="same instant, at a"):
        check_no_leakage([PictureUse("c", NOON, "evaluation")], paint, kind="hour")


def test_leaks_are_refused_by_content(tmp_path):
    levels = np.random.default_rng(0).integers(0, 256, (12, 16, 3), np.uint8)
    camera = Camera(16, 12, 20.0, 20.0, 8.0, 6.0, np.eye(4))
    seen = Observation(linear_from_srgb(levels / np.float32(255.0)), np.ones((12, 16), bool), camera, NOON, "a")
    write_png8(tmp_path / "copy.png", levels)
    assert content_hash(levels) == observation_hash(seen) == file_content_hash(tmp_path / "copy.png")
    renamed = PictureUse("elsewhere", NOON + timedelta(days=1), "evaluation", file_content_hash(tmp_path / "copy.png"))
    with pytest.raises(LeakageError, match="same pixels"):
        check_no_leakage([renamed], [picture_use(seen, "training")])
    levels[0, 0, 0] ^= 1
    assert content_hash(levels) != observation_hash(seen)


def test_uses_must_be_plain():
    with pytest.raises(ValueError, match="purpose"):
        PictureUse("a", NOON, "decoration")
    with pytest.raises(ValueError, match="offset"):
        PictureUse("a", NOON.replace(tzinfo=None), "painting")
    with pytest.raises(ValueError, match="kind"):
        check_no_leakage([], [], kind="year")
    with pytest.raises(ValueError, match="uint8"):
        content_hash(np.zeros((2, 2, 3)))


def test_ssim_map_says_where_pictures_differ(pair):
    truth = pair[0]
    picture = truth.copy()
    picture[8:12, 8:12] = 1.0 - picture[8:12, 8:12]
    shown = ssim_map(truth, picture)
    assert shown.shape == truth.shape[:2]
    assert shown[8:12, 8:12].max() < 0.9
    # Windows of 11 pixels that do not touch the square are of equal content.
    np.testing.assert_allclose(shown[18:, 18:], 1.0, atol=1e-6)
