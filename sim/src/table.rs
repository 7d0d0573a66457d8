//! The statistics of a data set as a table for people.

use comfy_table::{CellAlignment, Table, presets::NOTHING};
use gatsbi_sim::look::{Spread, Statistics};

/// Lines of the table: what it is, and its mean and range or its one value.
pub(crate) fn table(statistics: &Statistics) -> Table {
    let s = statistics;
    let mut table = Table::new();
    table.load_style(NOTHING);
    table.set_header(["", "mean", "min", "p10", "p90", "max"]);
    let mut add = |name: &str, cells: [String; 5]| {
        let [mean, min, p10, p90, max] = cells;
        table.add_row([name.to_owned(), mean, min, p10, p90, max]);
    };
    let mut one = |name: &str, value: String| {
        add(name, [value, String::new(), String::new(), String::new(), String::new()]);
    };
    one("episodes", s.episodes.to_string());
    one("frames", s.frames.to_string());
    let shares = [
        ("episodes with agent contact", s.episodes_with_contact),
        ("frames with agent contact", s.frames_with_contact),
        ("episodes with object contact", s.episodes_with_object_contact),
        ("objects that moved > 3 cm", s.moved),
        ("objects that are seen", s.visible),
        ("pixels that change", s.changed),
    ];
    for (name, share) in shares {
        if let Some(share) = share {
            one(name, percent(share));
        }
    }
    if let Some(left) = s.left_tray {
        one("objects that left the tray", left.to_string());
    }
    if let Some(pinholes) = s.pinholes {
        one("pinholes in the agent, a frame", format!("{pinholes:.3}"));
    }
    let number: fn(f64) -> String = |value| format!("{value:.1}");
    let millimetres: fn(f64) -> String = |value| format!("{value:.3}");
    let spreads = [
        ("objects", s.objects, number),
        ("objects touched", s.objects_touched, number),
        ("frames with object contact", s.frames_with_object_contact, number),
        ("path of an object, m", s.path, millimetres),
        ("height of an object, m", s.object_height, millimetres),
        ("height of the hand, m", s.hand_height, millimetres),
        ("speed of the hand, m/s", s.hand_speed, millimetres),
        ("agent's share of the picture", s.agent_share, percent),
        ("width of an object, pixels", s.object_width, number),
        ("height of an object, pixels", s.object_tall, number),
    ];
    for (name, spread, format) in spreads {
        if let Some(Spread { mean, min, p10, p90, max }) = spread {
            add(name, [mean, min, p10, p90, max].map(format));
        }
    }
    for column in table.column_iter_mut().skip(1) {
        column.set_cell_alignment(CellAlignment::Right);
    }
    table
}

fn percent(share: f64) -> String {
    format!("{:.1} %", 100.0 * share)
}
