//! A pinhole camera that stands still: rays out of its pixels, points into them.

use nalgebra::{Matrix3, Vector3};

/// Where the camera is and what it sees. Frames are square.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Camera {
    pub(crate) position: Vector3<f64>,
    /// Columns: right, up, back.
    pub(crate) axes: Matrix3<f64>,
    /// Vertical angle of view, degrees.
    pub(crate) fovy: f64,
}

impl Camera {
    /// A camera that looks at a point, upright.
    pub(crate) fn new(position: [f64; 3], look_at: [f64; 3], fovy: f64) -> Self {
        let position = Vector3::from(position);
        let forward = (Vector3::from(look_at) - position).normalize();
        let right = forward.cross(&Vector3::z()).normalize();
        let up = right.cross(&forward);
        Self { position, axes: Matrix3::from_columns(&[right, up, -forward]), fovy }
    }

    /// Unit directions through the centres of `size` by `size` pixels, row by row from the top.
    pub(crate) fn rays(&self, size: u32) -> Vec<[f64; 3]> {
        let focal = self.focal(size);
        let centre = (f64::from(size) - 1.0) / 2.0;
        let ray = |(row, column): (u32, u32)| {
            let [x, y] = [f64::from(column) - centre, centre - f64::from(row)];
            (self.axes * Vector3::new(x / focal, y / focal, -1.0)).normalize().into()
        };
        (0..size).flat_map(|row| (0..size).map(move |column| (row, column))).map(ray).collect()
    }

    /// Where a point appears: x right, y down, 0 is the centre of the first pixel. It may lie outside the picture.
    pub(crate) fn project(&self, point: Vector3<f64>, size: u32) -> [f64; 2] {
        let seen = self.axes.transpose() * (point - self.position);
        let (focal, centre) = (self.focal(size), (f64::from(size) - 1.0) / 2.0);
        [centre - focal * seen.x / seen.z, centre + focal * seen.y / seen.z]
    }

    /// Distance from the pinhole to the picture, in pixels.
    fn focal(&self, size: u32) -> f64 {
        f64::from(size) / 2.0 / (self.fovy.to_radians() / 2.0).tan()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_point_on_a_ray_appears_in_its_pixel() {
        let camera = Camera::new([1.16, 0.1, 0.92], [0.47, 0.0, 0.04], 39.0);
        let rays = camera.rays(64);
        for (pixel, ray) in rays.iter().enumerate() {
            let [x, y] = camera.project(camera.position + 0.8 * Vector3::from(*ray), 64);
            let expected = [(pixel % 64) as f64, (pixel / 64) as f64];
            assert!((x - expected[0]).abs() < 1e-9 && (y - expected[1]).abs() < 1e-9);
        }
        let middle = camera.project(Vector3::new(0.47, 0.0, 0.04), 64);
        assert!(middle.iter().all(|at| (at - 31.5).abs() < 1e-9), "{middle:?}");
    }

    #[test]
    fn up_is_up_and_right_is_right() {
        // In front of the robot, looking back at it: the world's y points to the right.
        let camera = Camera::new([2.0, 0.0, 1.0], [0.0, 0.0, 0.0], 45.0);
        let [x, y] = camera.project(Vector3::new(0.0, 0.1, 0.2), 64);
        assert!(x > 31.5 && y < 31.5, "{x} {y}");
    }
}
