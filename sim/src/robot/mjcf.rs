//! The scene as MuJoCo reads it: table, tray, light, camera and objects around the robot's own file.
//!
//! Collision bits: the table and its rim have type 1, objects type 2 and meet all (1 + 2 + 4), the robot has type 4 and
//! meets nothing by itself. So it touches objects, and never the table nor itself: a hand that scrapes along the table
//! would be held by friction, and the action would no longer tell where it goes.
//!
//! An object that is squeezed against the rim may climb it; an invisible fence keeps it on the tray.

use crate::{
    camera::Camera,
    robot::{
        catalogue::{Layout, Shape, Tray},
        world::Object,
    },
};

/// Half the thickness of the rim.
const RIM: f64 = 0.012;
/// How far the table reaches beyond the tray.
const MARGIN: f64 = 0.12;
/// The fence begins so far behind the inner side of the rim, so that objects meet the rim first; half its size.
const FENCE_BEHIND: f64 = 0.002;
const FENCE_THICKNESS: f64 = 0.05;
const FENCE_HEIGHT: f64 = 0.2;

/// The text of the scene. The robot comes first, so that its joints have the first places of the state.
pub(crate) fn scene(layout: &Layout, objects: &[Object], camera: &Camera, size: u32) -> String {
    let Layout { tray, look, timestep, .. } = layout;
    let ([x, y], [half_x, half_y], friction) = (tray.centre, tray.half, tray.friction);
    let rim = tray.rim_height / 2.0;
    let [table, rim_colour, floor] = [look.table, look.rim, look.floor].map(numbers);
    let rims = walls(tray, 0.0, RIM).map(|([x, y], [half_x, half_y])| {
        format!(
            r#"<geom type="box" pos="{x} {y} {rim}" size="{half_x} {half_y} {rim}" rgba="{rim_colour} 1"
                contype="1" conaffinity="0" friction="{friction} 0.001 0.00001"/>"#
        )
    });
    let fences = walls(tray, FENCE_BEHIND, FENCE_THICKNESS).map(|([x, y], [half_x, half_y])| {
        format!(
            r#"<geom type="box" pos="{x} {y} {FENCE_HEIGHT}" size="{half_x} {half_y} {FENCE_HEIGHT}" group="3"
                contype="1" conaffinity="0" friction="{friction} 0.001 0.00001"/>"#
        )
    });
    let bodies: String =
        objects.iter().enumerate().map(|(i, object)| body(i, object, layout)).collect();
    let (right, up) = (camera.axes.column(0), camera.axes.column(1));
    format!(
        r#"<mujoco model="scene">
  <include file="{robot}"/>
  <option timestep="{timestep}" integrator="implicitfast" cone="elliptic" iterations="30" impratio="3"/>
  <visual>
    <global offwidth="{size}" offheight="{size}"/>
    <quality shadowsize="256" offsamples="4" numslices="16" numstacks="12"/>
    <headlight ambient="0.64 0.64 0.64" diffuse="0.25 0.25 0.25" specular="0.05 0.05 0.05"/>
    <map znear="0.02" zfar="8"/>
  </visual>
  <statistic extent="1" center="{x} {y} 0.2"/>
  <worldbody>
    <light type="directional" pos="0.2 -0.7 2.2" dir="0.12 0.3 -1" castshadow="true"
      ambient="0 0 0" diffuse="0.16 0.16 0.16" specular="0.15 0.15 0.15"/>
    <geom type="plane" size="4 4 0.1" pos="0 0 -0.8" rgba="{floor} 1" contype="0" conaffinity="0"/>
    <geom type="box" pos="{x} {y} -0.02" size="{table_x} {table_y} 0.02" rgba="{table} 1" contype="1" conaffinity="0"
      friction="{friction} 0.001 0.00001" priority="1" solref="0.01 1"/>
    {rims}
    {fences}
    <camera pos="{position}" xyaxes="{right} {up}" fovy="{fovy}"/>
    {bodies}
  </worldbody>
</mujoco>"#,
        robot = layout.robot.model(),
        rims = rims.concat(),
        fences = fences.concat(),
        table_x = half_x + MARGIN,
        table_y = half_y + MARGIN,
        position = numbers(camera.position.iter().copied()),
        right = numbers(right.iter().copied()),
        up = numbers(up.iter().copied()),
        fovy = camera.fovy,
    )
}

/// Centres and half sizes of four walls around the tray, `behind` its edge and twice `half` thick.
fn walls(tray: &Tray, behind: f64, half: f64) -> [([f64; 2], [f64; 2]); 4] {
    let [x, y] = tray.centre;
    let [half_x, half_y] = tray.half.map(|side| side + behind);
    [
        ([x - half_x - half, y], [half, half_y + 2.0 * half]),
        ([x + half_x + half, y], [half, half_y + 2.0 * half]),
        ([x, y - half_y - half], [half_x, half]),
        ([x, y + half_y + half], [half_x, half]),
    ]
}

fn body(index: usize, object: &Object, layout: &Layout) -> String {
    let half = object.half_size;
    let (kind, size) = match object.shape {
        Shape::Cube => ("box", format!("{half} {half} {half}")),
        Shape::Cylinder => ("cylinder", format!("{half} {half}")),
        Shape::Ball => ("sphere", half.to_string()),
    };
    let contact = if layout.objects.elastic {
        // Stiffness and damping as such: hardly any energy is lost in a collision.
        r#"condim="3" solref="-40000 -4""#
    } else {
        r#"condim="4""#
    };
    format!(
        r#"<body name="object{index}"><freejoint/>
      <geom type="{kind}" size="{size}" rgba="{colour} 1" density="{density}" contype="2" conaffinity="7"
        friction="{friction} 0.002 0.00005" {contact}/></body>"#,
        colour = numbers(object.colour),
        density = layout.objects.density,
        friction = layout.tray.friction,
    )
}

fn numbers(values: impl IntoIterator<Item = f64>) -> String {
    values.into_iter().map(|value| value.to_string()).collect::<Vec<_>>().join(" ")
}
