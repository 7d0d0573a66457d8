//! Crops out of images and patches into images (object spec section 4).
//!
//! Boxes are `z_where = (s_x, s_y, t_x, t_y)`: the fraction of the image's side they cover and their centre in
//! [-1, 1], x right, y down. Sampling is bilinear with zeros outside and `align_corners = false`.

use tch::{Kind, Tensor};

/// Keeps the inverse transform of an empty box finite.
const EPS: f64 = 1e-9;

/// Cuts `side x side` glimpses out of images.
///
/// # Shapes
/// `image [B, C, H, W]`, `z_where [B, N, 4]`; returns `[B, N, C, side, side]`.
pub(crate) fn crop(image: &Tensor, z_where: &Tensor, side: i64) -> Tensor {
    let (b, c, h, w) = image.size4().expect("an image batch has four axes");
    let n = z_where.size()[1];
    let boxes = z_where.reshape([b * n, 4]);
    let (scale, shift) = (boxes.narrow(1, 0, 2), boxes.narrow(1, 2, 2));
    let images = image.unsqueeze(1).expand([b, n, c, h, w], false).reshape([b * n, c, h, w]);
    sample(&images, &scale, &shift, side, side).view([b, n, c, side, side])
}

/// Places glimpses into empty images.
///
/// # Shapes
/// `glimpse [B, N, C, s, s]`, `z_where [B, N, 4]`; returns `[B, N, C, side, side]`.
pub(crate) fn place(glimpse: &Tensor, z_where: &Tensor, side: i64) -> Tensor {
    let size = glimpse.size();
    let (b, n, c, s) = (size[0], size[1], size[2], size[3]);
    let boxes = z_where.reshape([b * n, 4]);
    let inverse_scale = (boxes.narrow(1, 0, 2) + EPS).reciprocal();
    let shift = -(boxes.narrow(1, 2, 2) * &inverse_scale);
    sample(&glimpse.reshape([b * n, c, s, s]), &inverse_scale, &shift, side, side)
        .view([b, n, c, side, side])
}

/// Samples `images` at `scale * (x, y) + shift` for every output pixel's (x, y).
fn sample(images: &Tensor, scale: &Tensor, shift: &Tensor, rows: i64, columns: i64) -> Tensor {
    let (n, c, _, _) = images.size4().expect("an image batch has four axes");
    // theta = [[s_x, 0, t_x], [0, s_y, t_y]]
    let theta = Tensor::cat(&[scale.diag_embed(0, -2, -1), shift.unsqueeze(-1)], -1); // [n, 2, 3]
    let grid = Tensor::affine_grid_generator(&theta, [n, c, rows, columns], false);
    images.grid_sampler(&grid, 0, 0, false)
}

/// Intersection over union of boxes, of which empty ones overlap nothing (object spec 4.4).
///
/// # Shapes
/// `a [B, N, 4]`, `b [B, M, 4]`; returns `[B, N, M]`.
pub(crate) fn iou(a: &Tensor, b: &Tensor) -> Tensor {
    let corners = |z_where: &Tensor| {
        let size = z_where.narrow(-1, 0, 2);
        let centre = (z_where.narrow(-1, 2, 2) + 1.0) * 0.5;
        (&centre - &size * 0.5, centre + size * 0.5)
    };
    let area = |low: &Tensor, high: &Tensor| {
        (high - low).clamp_min(0.0).prod_dim_int(-1, false, Kind::Float)
    };
    let ((low_a, high_a), (low_b, high_b)) = (corners(a), corners(b));
    let (area_a, area_b) = (area(&low_a, &high_a).unsqueeze(2), area(&low_b, &high_b).unsqueeze(1));
    let low = low_a.unsqueeze(2).maximum(&low_b.unsqueeze(1));
    let high = high_a.unsqueeze(2).minimum(&high_b.unsqueeze(1));
    let intersection = area(&low, &high); // [B, N, M]
    let union = &area_a + &area_b - &intersection + 1e-5;
    let empty = area_a.eq(0.0).logical_or(&area_b.eq(0.0));
    (intersection / union).masked_fill(&empty, 0.0)
}

/// Pixel positions in [-1, 1] of a row of `count` pixels, `(2 i + 1) / count - 1`.
pub(crate) fn pixel_centres(count: i64, like: &Tensor) -> Tensor {
    (Tensor::arange(count, (Kind::Float, like.device())) * 2.0 + 1.0) / count as f64 - 1.0
}
