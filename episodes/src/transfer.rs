//! `gatsbi-episodes import` and `export`: between our data sets and other formats.

use std::path::PathBuf;

use anyhow::ensure;
use clap::{Args, Subcommand, ValueEnum};
use gatsbi_episodes::{
    ActionDimension, Dataset, Fit, NpzImport,
    exchange::{
        Hdf5Source, ImportOptions, Imported, LerobotSource, McapSource, Skipped, TfrecordSource,
        export_lerobot, export_mcap, import_hdf5, import_lerobot, import_mcap, import_tfrecord,
    },
    import_npz,
};

use crate::{Writer, print, print_written, progress_bar};

#[derive(Debug, Subcommand)]
pub(crate) enum Import {
    /// A LeRobotDataset v3; videos are decoded by the program ffmpeg.
    Lerobot(Lerobot),
    /// An MCAP recording, or a folder of them: Foxglove's or ROS 2's images and commands.
    Mcap(Mcap),
    /// An HDF5 file in robomimic's layout: data/demo_0/obs/CAMERA, data/demo_0/actions.
    Hdf5(Hdf5),
    /// TFRecords with one episode each, as those of BAIR robot pushing.
    Tfrecord(Tfrecord),
    /// A numpy archive with the arrays rgb [E,T,H,W,3] u1, act [E,T,A] f4 and, if known, lab [E,T,H,W] u1 (0 background,
    /// 1 agent, 2.. objects), obj [E,T,M,3] f4 (metres, NaN = absent) and n [E] (object counts).
    Npz(Npz),
}

#[derive(Debug, Subcommand)]
pub(crate) enum Export {
    /// A LeRobotDataset v3 with its frames as PNG in the tables.
    Lerobot(To),
    /// A folder of MCAP recordings, one for each episode.
    Mcap(To),
}

#[derive(Debug, Args)]
pub(crate) struct Lerobot {
    /// Folder of the data set.
    source: PathBuf,
    /// Image or video feature; needed where there are several.
    #[arg(long)]
    camera: Option<String>,
    /// Feature of the actions.
    #[arg(long, default_value = "action")]
    action: String,
    /// Feature that holds joint positions, to keep them too; often observation.state.
    #[arg(long)]
    joints: Option<String>,
    #[command(flatten)]
    common: Common,
}

#[derive(Debug, Args)]
pub(crate) struct Mcap {
    /// A recording, or a folder of .mcap files, each an episode.
    source: PathBuf,
    /// Topic of the pictures; needed where there are several.
    #[arg(long)]
    camera: Option<String>,
    /// Topic of the commands; needed where there are several.
    #[arg(long)]
    action: Option<String>,
    /// Field of a command that holds its numbers; by default values in JSON, velocity in a JointState.
    #[arg(long)]
    field: Option<String>,
    #[command(flatten)]
    common: Common,
}

#[derive(Debug, Args)]
pub(crate) struct Hdf5 {
    /// The file.
    source: PathBuf,
    /// Data set of pictures in obs; needed where there are several.
    #[arg(long)]
    camera: Option<String>,
    /// Data set in obs that holds joint positions, to keep them too; often robot0_joint_pos.
    #[arg(long)]
    joints: Option<String>,
    #[command(flatten)]
    common: Common,
}

#[derive(Debug, Args)]
pub(crate) struct Tfrecord {
    /// A file, or a folder of .tfrecord or .tfrecords files.
    source: PathBuf,
    /// Key of the pictures, {} for the number of the frame.
    #[arg(long, default_value = "{}/image_main/encoded")]
    frames: String,
    /// Key of the commands, {} for the number of the frame.
    #[arg(long, default_value = "{}/action")]
    actions: String,
    #[command(flatten)]
    common: Common,
}

#[derive(Debug, Args)]
struct Common {
    /// Folder to create.
    #[arg(long)]
    out: PathBuf,
    /// Name of the data set; by default the source's.
    #[arg(long)]
    name: Option<String>,
    /// Side of the square frames to make; by default frames stay as they are.
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=8192))]
    size: Option<u32>,
    /// How frames are brought to that size.
    #[arg(long, value_enum, default_value = "stretch", requires = "size")]
    fit: HowToFit,
    /// Seconds between two frames; by default what the source says.
    #[arg(long)]
    frame_period: Option<f64>,
    /// Names of the action dimensions, separated by commas; by default the source's.
    #[arg(long, value_delimiter = ',')]
    action_names: Vec<String>,
    /// Units of the action dimensions, separated by commas; one alone holds for all.
    #[arg(long, value_delimiter = ',')]
    action_units: Vec<String>,
    /// Id of the first episode, the others count on from it; by default the source's.
    #[arg(long)]
    first_id: Option<u64>,
    #[command(flatten)]
    writer: Writer,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum HowToFit {
    /// Both sides to the size.
    Stretch,
    /// The largest centred square, then to the size.
    CentreCrop,
}

#[derive(Debug, Args)]
pub(crate) struct To {
    /// Data-set folder or .parquet file.
    path: PathBuf,
    /// Folder to create.
    #[arg(long)]
    out: PathBuf,
}

#[derive(Debug, Args)]
pub(crate) struct Npz {
    /// The archive.
    file: PathBuf,
    /// Folder to create.
    #[arg(long)]
    out: PathBuf,
    /// Name of the data set.
    #[arg(long, default_value = "push1")]
    name: String,
    /// Seconds between two frames.
    #[arg(long, default_value_t = 0.2)]
    frame_period: f64,
    /// Names of the action dimensions, separated by commas.
    #[arg(
        long,
        value_delimiter = ',',
        default_value = "panda_joint1,panda_joint2,panda_joint3,panda_joint4,panda_joint5,panda_joint6,panda_joint7"
    )]
    action_names: Vec<String>,
    /// Units of the action dimensions, separated by commas; one alone holds for all.
    #[arg(long, value_delimiter = ',', default_value = "rad/s")]
    action_units: Vec<String>,
    /// Program, simulator or robot that made the data, kept as its provenance.
    #[arg(long, default_value = "unknown")]
    generator: String,
    /// Id of the first episode; the others count on from it.
    #[arg(long, default_value_t = 0)]
    first_id: u64,
    #[command(flatten)]
    writer: Writer,
}

impl Import {
    pub(crate) fn run(self) -> anyhow::Result<()> {
        let bar = progress_bar();
        let mut progress = |done, all| {
            bar.set_length(all as u64);
            bar.set_position(done as u64);
        };
        let (common, imported) = match self {
            Self::Npz(npz) => return npz.run(),
            Self::Lerobot(Lerobot { source, camera, action, joints, common }) => {
                let features = LerobotSource { camera, action: Some(action), joints };
                let (out, options, writer) = common.parts();
                let imported =
                    import_lerobot(&source, out, &features, &options, writer, &mut progress)?;
                (common, imported)
            }
            Self::Mcap(Mcap { source, camera, action, field, common }) => {
                let topics = McapSource { camera, action, field };
                let (out, options, writer) = common.parts();
                let imported = import_mcap(&source, out, &topics, &options, writer, &mut progress)?;
                (common, imported)
            }
            Self::Hdf5(Hdf5 { source, camera, joints, common }) => {
                let sets = Hdf5Source { camera, joints };
                let (out, options, writer) = common.parts();
                let imported = import_hdf5(&source, out, &sets, &options, writer, &mut progress)?;
                (common, imported)
            }
            Self::Tfrecord(Tfrecord { source, frames, actions, common }) => {
                let keys = TfrecordSource { frames, actions };
                let (out, options, writer) = common.parts();
                let imported =
                    import_tfrecord(&source, out, &keys, &options, writer, &mut progress)?;
                (common, imported)
            }
        };
        bar.finish_and_clear();
        let Imported { manifest, skipped } = imported;
        print_written(&common.out, &manifest)?;
        print_skipped(&skipped)
    }
}

impl Export {
    pub(crate) fn run(self) -> anyhow::Result<()> {
        let bar = progress_bar();
        let mut progress = |done, all| {
            bar.set_length(all as u64);
            bar.set_position(done as u64);
        };
        let (to, skipped) = match self {
            Self::Lerobot(to) => {
                let skipped = export_lerobot(&Dataset::open(&to.path)?, &to.out, &mut progress)?;
                (to, skipped)
            }
            Self::Mcap(to) => {
                let skipped = export_mcap(&Dataset::open(&to.path)?, &to.out, &mut progress)?;
                (to, skipped)
            }
        };
        bar.finish_and_clear();
        print(&format!("wrote {}\n", to.out.display()))?;
        print_skipped(&skipped)
    }
}

impl Common {
    fn parts(&self) -> (&PathBuf, ImportOptions, gatsbi_episodes::WriterOptions) {
        let options = ImportOptions {
            name: self.name.clone(),
            frame_period_seconds: self.frame_period,
            action_names: self.action_names.clone(),
            action_units: self.action_units.clone(),
            size: self.size,
            fit: match self.fit {
                HowToFit::Stretch => Fit::Stretch,
                HowToFit::CentreCrop => Fit::CentreCrop,
            },
            first_id: self.first_id,
        };
        (&self.out, options, self.writer.options())
    }
}

impl Npz {
    fn run(&self) -> anyhow::Result<()> {
        let (names, units) = (&self.action_names, &self.action_units);
        ensure!(
            units.len() == 1 || units.len() == names.len(),
            "--action-units gives {} units for the {} names of --action-names; give one for all or one for each",
            units.len(),
            names.len()
        );
        let dimension = |(name, unit): (&String, &String)| ActionDimension {
            name: name.clone(),
            unit: unit.clone(),
        };
        let import = NpzImport {
            name: self.name.clone(),
            frame_period_seconds: self.frame_period,
            actions: names.iter().zip(units.iter().cycle()).map(dimension).collect(),
            generator: self.generator.clone(),
            first_id: self.first_id,
        };
        let bar = progress_bar();
        let options = self.writer.options();
        let manifest = import_npz(&self.file, &self.out, &import, options, |done, all| {
            bar.set_length(all as u64);
            bar.set_position(done as u64);
        })?;
        bar.finish_and_clear();
        print_written(&self.out, &manifest)
    }
}

fn print_skipped(skipped: &[Skipped]) -> anyhow::Result<()> {
    skipped.iter().try_for_each(|Skipped { what, why }| print(&format!("left out {what}: {why}\n")))
}
