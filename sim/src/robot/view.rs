//! Pictures of a world: colours by OpenGL, labels by rays.
//!
//! A ray through a pixel's centre finds the geom that the pixel shows; the renderer offers no second pass for labels.
//! Where the decimated parts of the robot leave a crack, a ray may find the table behind: such holes are filled.

use mujoco_rs::{
    prelude::{MjModel, MjvCamera, MjvOption},
    renderer::MjRenderer,
};

use crate::{
    Error, Result,
    camera::Camera,
    environment::{AGENT, BACKGROUND},
    robot::world::World,
};

/// Geoms of these groups are seen: what only collides is in group 3.
const SEEN: [u8; 6] = [1, 1, 1, 0, 0, 0];

/// Largest group of pixels that counts as a hole; at 64x64 a crack between two parts is one or two pixels.
const HOLE: usize = 4;

/// The camera with its OpenGL context.
#[derive(Debug)]
pub(crate) struct View {
    eye: [f64; 3],
    rays: Vec<[f64; 3]>,
    /// Of the picture, pixels.
    size: usize,
    renderer: MjRenderer,
}

impl View {
    /// Opens an OpenGL context for scenes like this one; it is kept for all that follow.
    pub(crate) fn open(camera: Camera, size: u32, model: &MjModel) -> Result<Self> {
        let option = MjvOption { geomgroup: SEEN, sitegroup: [0; 6], ..MjvOption::default() };
        let renderer = MjRenderer::builder()
            .width(size)
            .height(size)
            .camera(MjvCamera::new_fixed(0))
            .opts(option)
            .build(model)
            .map_err(|source| Error::NoRenderer { source })?;
        Ok(Self {
            eye: camera.position.into(),
            rays: camera.rays(size),
            size: size as usize,
            renderer,
        })
    }

    /// Colours `[H,W,3]` and labels `[H,W]`.
    pub(crate) fn of(&mut self, world: &mut World) -> Result<(Vec<u8>, Vec<u8>)> {
        let failed = |source| Error::Render { source };
        self.renderer.sync_data(&mut world.data).map_err(failed)?;
        self.renderer.render().map_err(failed)?;
        let rgb = self.renderer.rgb_flat().unwrap_or_default().to_vec();

        // One by one: `multi_ray` leaves geoms out by their angles as seen from here, and among them some that it hits.
        let mut label = |ray| {
            let (geom, _) = world.data.ray(&self.eye, ray, Some(&SEEN), true, None, None);
            geom.map_or(BACKGROUND, |geom| world.label(geom))
        };
        let mut mask: Vec<u8> = self.rays.iter().map(&mut label).collect();
        for hole in pinholes(&mask, self.size) {
            mask[hole] = AGENT;
        }
        Ok((rgb, mask))
    }
}

/// Pixels of the background that lie in the agent in groups of at most [`HOLE`].
pub(crate) fn pinholes(mask: &[u8], width: usize) -> Vec<usize> {
    let mut seen = vec![false; mask.len()];
    let mut holes = Vec::new();
    for start in 0..mask.len() {
        if mask[start] != BACKGROUND || seen[start] {
            continue;
        }
        seen[start] = true;
        let (mut group, mut next, mut enclosed) = (vec![start], 0, true);
        while next < group.len() {
            let at = group[next];
            next += 1;
            let column = at % width;
            let neighbours = [
                (column > 0).then(|| at - 1),
                (column + 1 < width).then(|| at + 1),
                at.checked_sub(width),
                Some(at + width).filter(|&below| below < mask.len()),
            ];
            for neighbour in neighbours {
                match neighbour {
                    Some(at) if mask[at] == AGENT => {}
                    Some(at) if mask[at] == BACKGROUND => {
                        if !seen[at] {
                            seen[at] = true;
                            group.push(at);
                        }
                    }
                    _ => enclosed = false,
                }
            }
        }
        if enclosed && group.len() <= HOLE {
            holes.append(&mut group);
        }
    }
    holes
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_hole_has_the_agent_all_around() {
        let mask = [
            0, 1, 1, 1, 0, 0, //
            1, 0, 0, 1, 1, 0, //
            1, 0, 1, 1, 0, 1, //
            0, 1, 0, 0, 1, 0, //
            0, 0, 1, 1, 0, 0,
        ];
        assert_eq!(pinholes(&mask, 6), [7, 8, 13, 16, 20, 21]);
        let mut object = mask;
        object[20] = 2;
        assert_eq!(pinholes(&object, 6), [7, 8, 13, 16], "an object is seen through a gap");
        let wide = [&[1; 8][..], &[1, 0, 0, 0, 0, 0, 0, 1], &[1; 8]].concat();
        assert!(pinholes(&wide, 8).is_empty(), "the arm may enclose a piece of the background");
    }
}
