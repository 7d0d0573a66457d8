//! The balls as a depth image: near is bright. Depth is exact in each of nine samples of a pixel; labels are those of
//! the middle one.

use crate::{
    BACKGROUND, FIRST_OBJECT,
    balls::{BOX, motion::Motion},
    camera::Camera,
};

/// Distance of the camera from the middle of the box, metres.
const DISTANCE: f64 = 3.2;
/// The front of the box takes this much of the picture.
const FILL: f64 = 0.98;
/// Samples of a pixel along each side.
const SAMPLES: usize = 3;
/// Brightness of the farthest point, and what the nearest has more.
const DARKEST: f64 = 0.08;
const RANGE: f64 = 0.9;

/// The camera in front of the box.
#[derive(Debug)]
pub(super) struct View {
    camera: Camera,
    size: usize,
    /// Through the samples, row by row.
    rays: Vec<[f64; 3]>,
}

impl View {
    pub(super) fn new(size: u32) -> Self {
        let half_picture = BOX[0] / FILL / (DISTANCE - BOX[1]);
        let fovy = 2.0 * half_picture.atan().to_degrees();
        let camera = Camera::new([0.0, -DISTANCE, 0.0], [0.0; 3], fovy);
        Self { camera, size: size as usize, rays: camera.rays(size * SAMPLES as u32) }
    }

    /// Where a point appears.
    pub(super) fn project(&self, point: [f64; 3]) -> [f64; 2] {
        self.camera.project(point.into(), self.size as u32)
    }

    /// Brightness `[H,W,3]` and labels `[H,W]`.
    pub(super) fn of(&self, motion: &Motion) -> (Vec<u8>, Vec<u8>) {
        let samples: Vec<(f64, u8)> = self.rays.iter().map(|&ray| look(ray, motion)).collect();
        let width = self.size * SAMPLES;
        let pixel = |at: usize| (at / self.size * SAMPLES, at % self.size * SAMPLES);
        let brightness = |at: usize| {
            let (row, column) = pixel(at);
            let rows = row..row + SAMPLES;
            let samples = rows.flat_map(|row| &samples[row * width + column..][..SAMPLES]);
            let mean = samples.map(|(depth, _)| brightness(*depth)).sum::<f64>()
                / (SAMPLES * SAMPLES) as f64;
            [(255.0 * mean) as u8; 3]
        };
        let label = |at: usize| {
            let (row, column) = pixel(at);
            samples[(row + SAMPLES / 2) * width + column + SAMPLES / 2].1
        };
        let pixels = self.size * self.size;
        ((0..pixels).flat_map(brightness).collect(), (0..pixels).map(label).collect())
    }
}

/// How deep a ray goes into the picture, and what it meets.
fn look(ray: [f64; 3], motion: &Motion) -> (f64, u8) {
    let eye = [0.0, -DISTANCE, 0.0];
    // The ray leaves the box by the side that it meets first.
    let leave = |axis: usize| (BOX[axis].copysign(ray[axis]) - eye[axis]) / ray[axis];
    let mut nearest = leave(0).min(leave(1)).min(leave(2));
    let mut label = BACKGROUND;
    for (ball, (position, radius)) in motion.positions.iter().zip(&motion.radii).enumerate() {
        let from: [f64; 3] = std::array::from_fn(|axis| eye[axis] - position[axis]);
        let dot = |a: &[f64; 3], b: &[f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
        let along = dot(&from, &ray);
        let discriminant = along * along - dot(&from, &from) + radius * radius;
        if discriminant > 0.0 {
            let distance = -along - discriminant.sqrt();
            if distance < nearest {
                (nearest, label) = (distance, FIRST_OBJECT + ball as u8);
            }
        }
    }
    (nearest * ray[1], label)
}

fn brightness(depth: f64) -> f64 {
    let (near, far) = (DISTANCE - BOX[1], DISTANCE + BOX[1]);
    DARKEST + RANGE * (1.0 - (depth - near) / (far - near)).clamp(0.0, 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nearer_ball_hides_the_farther_one() {
        let view = View::new(64);
        let ball = |y| [0.0, y, 0.0];
        let motion = |positions: Vec<[f64; 3]>| Motion {
            velocities: vec![[0.0; 3]; positions.len()],
            radii: vec![0.2; positions.len()],
            positions,
        };
        let middle = 32 * 64 + 32;
        let (rgb, mask) = view.of(&motion(vec![ball(0.3), ball(-0.3)]));
        assert_eq!(mask[middle], FIRST_OBJECT + 1);
        let (farther, _) = view.of(&motion(vec![ball(0.3)]));
        let (empty, labels) = view.of(&motion(vec![]));
        assert!(rgb[3 * middle] > farther[3 * middle] && farther[3 * middle] > empty[3 * middle]);
        assert!(labels.iter().all(|&label| label == BACKGROUND));
    }

    #[test]
    fn a_ball_appears_where_it_is_projected() {
        let view = View::new(64);
        let position = [0.4, 0.1, 0.5];
        let motion =
            Motion { positions: vec![position], velocities: vec![[0.0; 3]], radii: vec![0.15] };
        let (_, mask) = view.of(&motion);
        let seen: Vec<usize> = (0..mask.len()).filter(|&at| mask[at] >= FIRST_OBJECT).collect();
        let mean = |part: fn(usize) -> usize| {
            seen.iter().map(|&at| part(at) as f64).sum::<f64>() / seen.len() as f64
        };
        let [x, y] = view.project(position);
        assert!((mean(|at| at % 64) - x).abs() < 0.5 && (mean(|at| at / 64) - y).abs() < 0.5);
        assert!(x > 32.0 && y < 32.0);
    }
}
